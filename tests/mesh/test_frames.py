"""Frames: what any msgpack reader sees, and what is refused."""

from __future__ import annotations

import random
from collections import Counter
from zlib import crc32

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.mesh.frames import LIMIT, Decoder, Encoder, Frame, Rejected

VECTOR = np.array([1.0, -2.5, 1e-300, 3.141592653589793])


def refused(data: bytes, decode: Decoder) -> str:
    with pytest.raises(Rejected) as e:
        decode(data)
    return e.value.cause


def test_any_msgpack_reader_reads_a_frame() -> None:
    data = Encoder("r1", "node-3")(7, 2, VECTOR)
    version, run, source, k, r, payload, check = msgpack.unpackb(data)
    assert (version, run, source, k, r) == (1, "r1", "node-3", 7, 2)
    assert np.array_equal(np.frombuffer(payload, "<f8"), VECTOR)
    assert int.from_bytes(check, "little") == crc32(data[:-4])


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.integers(0, LIMIT - 1),
    st.integers(0, LIMIT - 1),
    st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=40),
)
def test_what_is_written_is_read_to_the_bit(k: int, r: int, values: list[float]) -> None:
    vector = np.array(values, dtype=float)
    frame = Decoder("run", "plant")(Encoder("run", "plant")(k, r, vector))
    assert frame[:2] == (k, r)
    assert frame.vector.tobytes() == vector.tobytes()


@pytest.mark.parametrize("size", [0, 1, 31, 32, 8191, 8192, 100_000])
def test_every_payload_header_form(size: int) -> None:
    vector = np.arange(float(size))
    frame = Decoder("run", "plant")(Encoder("run", "plant")(1, 0, vector))
    assert np.array_equal(frame.vector, vector)


def test_a_block_of_rows_travels_row_by_row() -> None:
    rows = np.arange(6.0).reshape(2, 3)
    assert np.array_equal(Decoder("a", "b")(Encoder("a", "b")(0, 0, rows)).vector, rows.ravel())


def test_wrong_run_source_or_version_is_refused() -> None:
    data = Encoder("run", "node-1")(1, 0, VECTOR)
    for other in (Decoder("other", "node-1"), Decoder("run", "node-2")):
        assert refused(data, other) == "not from the expected source, run and version"
    assert refused(data[:1] + b"\x02" + data[2:], Decoder("run", "node-1")).startswith("not from the expected")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_refused(value: float) -> None:
    assert refused(Encoder("run", "p")(1, 0, np.array([1.0, value])), Decoder("run", "p")) == "not finite"


def test_a_frame_in_another_msgpack_form_is_refused() -> None:
    """A sender that packs small integers in one byte is not ours, even when its checksum is right."""
    body = b"\x97" + b"".join(msgpack.packb(f) for f in (1, "run", "p", 7, 0, VECTOR.tobytes()))
    data = body + b"\xc4\x04" + crc32(body + b"\xc4\x04").to_bytes(4, "little")
    assert msgpack.unpackb(data)[3] == 7
    assert refused(data, Decoder("run", "p")) == "layout"


def test_twenty_thousand_mutated_frames_are_refused_and_counted() -> None:
    """Flipped bits, cuts, insertions, swaps and noise: no crash, none accepted."""
    rng = random.Random(0)
    decode, encode = Decoder("run", "node-1"), Encoder("run", "node-1")
    causes: Counter[str] = Counter()
    for n in range(20_000):
        good = encode(n, n % 5, VECTOR * n)
        data = bytearray(good)
        kind, at = n % 5, rng.randrange(len(data))
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.randint(1, 20))
        elif kind == 3:
            data[at : at + 8] = rng.randbytes(8)
        else:
            data = bytearray(rng.randbytes(rng.randint(0, 200)))
        if bytes(data) != good:
            causes[refused(bytes(data), decode)] += 1
    assert sum(causes.values()) > 19_990
    assert set(causes) <= {
        "not from the expected source, run and version",
        "truncated",
        "checksum",
        "layout",
        "not finite",
    }


def test_a_received_vector_cannot_be_changed() -> None:
    frame = Decoder("run", "p")(Encoder("run", "p")(1, 0, VECTOR))
    assert isinstance(frame, Frame)
    with pytest.raises(ValueError, match="read-only"):
        frame.vector[0] = 1.0
