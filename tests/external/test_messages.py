"""Every message form against bytes that are put together here, byte by byte."""

from __future__ import annotations

import json
import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.sensors.messages import ENCODINGS, Refused, read

NUMBERS = (18.25, -0.0, 5e-324)
ARRAY, TEMPERATURE, FLOAT = "std_msgs/Float64MultiArray", "sensor_msgs/Temperature", "std_msgs/Float64"


def text(words: str) -> bytes:
    data = words.encode() + b"\0"
    return struct.pack("<I", len(data)) + data + b"\0" * (-len(data) % 4)


def array(numbers: tuple[float, ...], labels: tuple[str, ...] = ()) -> bytes:
    """std_msgs/Float64MultiArray in little-endian CDR: what a ROS 2 publisher serialises."""
    body = struct.pack("<I", len(labels))
    for label in labels:
        body += text(label) + struct.pack("<II", len(numbers), len(numbers))
    body += struct.pack("<II", 0, len(numbers))  # data_offset, count
    body += b"\0" * (-len(body) % 8) if numbers else b""  # float64 stand at multiples of eight behind the header
    return b"\x00\x01\x00\x00" + body + struct.pack(f"<{len(numbers)}d", *numbers)


def temperature(value: float, frame: str = "room5", order: str = "<") -> bytes:
    name = frame.encode() + b"\0"
    body = struct.pack(f"{order}iII", 1700000000, 999999999, len(name)) + name
    body += b"\0" * (-len(body) % 8)
    return (b"\x00\x01" if order == "<" else b"\x00\x00") + b"\0\0" + body + struct.pack(f"{order}dd", value, 0.04)


def rmw_zenoh(number: int) -> bytes:
    """The attachment of rmw_zenoh: number, nanoseconds, and the 16 bytes of the publisher's id behind their length."""
    return struct.pack("<qqB", number, 1700000000123456789, 16) + bytes(range(16))


@pytest.mark.parametrize(
    ("encoding", "payload", "numbers"),
    [
        ("json", b"[18.25, -0.0, 5e-324]", NUMBERS),
        ("json", b'{"y": [18.25, -0.0], "u": [5e-324]}', NUMBERS),
        ("json", b'{"y": 3}', (3.0,)),
        ("json", b"-7.5", (-7.5,)),
        ("float64", struct.pack("<3d", *NUMBERS), NUMBERS),
        (ARRAY, array(NUMBERS), NUMBERS),
        (ARRAY, array(NUMBERS, ("rooms", "x")), NUMBERS),
        (ARRAY, array(NUMBERS, ("abc",)) + b"\0\0\0", NUMBERS),
        (FLOAT, b"\x00\x01\x00\x00" + struct.pack("<d", 2.5), (2.5,)),
        (FLOAT, b"\x00\x00\x00\x00" + struct.pack(">d", 2.5), (2.5,)),
        *(
            (TEMPERATURE, temperature(19.75, frame, order), (19.75,))
            for frame in ("", "room5", "x" * 9)
            for order in "<>"
        ),
    ],
)
def test_good_messages(encoding: str, payload: bytes, numbers: tuple[float, ...]) -> None:
    found, number = read(encoding, payload, None, len(numbers))
    assert found.tobytes() == np.array(numbers).tobytes()
    assert number is None


def test_numbers_of_samples() -> None:
    assert read("json", b'{"k": 17, "y": [1]}', None, 1).number == 17
    assert read("float64", struct.pack("<d", 1.0), struct.pack("<q", 17), 1).number == 17
    assert read(ARRAY, array((1.0,)), rmw_zenoh(2**40), 1).number == 2**40
    assert read("json", b'{"k": 3, "y": [1]}', struct.pack("<q", 17), 1).number == 3, "what the message itself says"


@pytest.mark.parametrize(
    ("encoding", "payload", "attachment", "cause"),
    [
        ("json", b"[1, 2]", None, "2 numbers instead of 3"),
        ("json", b"[1, NaN, 2]", None, "not finite"),
        ("json", b"[1, 1e999, 2]", None, "not finite"),
        ("json", b"[1, 2, true]", None, "not json"),
        ("json", b'[1, 2, "3"]', None, "not json"),
        ("json", b'{"y": [1, 2, 3], "z": 0}', None, "not json"),
        ("json", b'{"k": 1.5, "y": [1, 2, 3]}', None, "not json"),
        ("json", b'{"k": true, "y": [1, 2, 3]}', None, "not json"),
        ("json", b'{"k": -1, "y": [1, 2, 3]}', None, "its number is negative"),
        ("json", b"[1, 2, " + b"9" * 400 + b"]", None, "not json"),
        ("json", b"[" * 4000, None, "not json"),
        ("json", b"\xff\xfe", None, "not json"),
        ("json", b"[1, 2, 3" + b" " * 9000 + b"]", None, "too large"),
        ("float64", struct.pack("<2d", 1, 2), None, "2 numbers instead of 3"),
        ("float64", struct.pack("<3d", 1, 2, math.inf), None, "not finite"),
        ("float64", b"\0" * 23, None, "not float64"),
        ("float64", struct.pack("<3d", 1, 2, 3), b"\0" * 7, "an attachment that is not a number"),
        ("float64", struct.pack("<3d", 1, 2, 3), struct.pack("<q", -2), "its number is negative"),
        (ARRAY, array((1.0, 2.0)), None, "2 numbers instead of 3"),
        (ARRAY, array((1.0, 2.0, math.nan)), None, "not finite"),
        (ARRAY, array(NUMBERS)[:-1], None, f"not {ARRAY}"),
        (ARRAY, array(NUMBERS) + b"\0" * 4, None, f"not {ARRAY}"),
        (ARRAY, b"\x00\x03" + array(NUMBERS)[2:], None, f"not {ARRAY}"),  # a parameter list, not plain CDR
        (ARRAY, b"\x00\x01\x00\x00\xff\xff\xff\xff", None, f"not {ARRAY}"),
        (ARRAY, b"\x00\x01\x00\x00" + struct.pack("<III", 0, 0, 2**32 - 1), None, f"not {ARRAY}"),
        (ARRAY, b"\x00\x01\x00\x00" + struct.pack("<III3d", 0, 1, 3, *NUMBERS), None, f"not {ARRAY}"),  # data_offset
        (TEMPERATURE, temperature(1.0), None, "1 numbers instead of 3"),
        (TEMPERATURE, array(NUMBERS), None, f"not {TEMPERATURE}"),
    ],
)
def test_bad_messages(encoding: str, payload: bytes, attachment: bytes | None, cause: str) -> None:
    with pytest.raises(Refused) as refused:
        read(encoding, payload, attachment, 3)
    assert refused.value.cause == cause


@settings(deadline=None, derandomize=True, max_examples=150)
@given(
    encoding=st.sampled_from(ENCODINGS), payload=st.binary(max_size=80), attachment=st.none() | st.binary(max_size=40)
)
def test_any_bytes_are_read_or_refused(encoding: str, payload: bytes, attachment: bytes | None) -> None:
    try:
        found, number = read(encoding, payload, attachment, 1)
    except Refused:
        return
    assert found.shape == (1,)
    assert np.isfinite(found).all()
    assert number is None or number >= 0


@settings(deadline=None, derandomize=True, max_examples=60)
@given(numbers=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=6), label=st.text(max_size=9))
def test_whatever_the_layout_the_numbers_come_through(numbers: list[float], label: str) -> None:
    label = label.replace("\0", "")
    exact = np.array(numbers, dtype=np.float64).tobytes()
    assert read(ARRAY, array(tuple(numbers), (label,)), None, len(numbers)).values.tobytes() == exact
    assert read("json", json.dumps(numbers).encode(), None, len(numbers)).values.tobytes() == exact
