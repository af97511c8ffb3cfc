"""What an outside publisher may send: bytes -> finite numbers, and the number of the sample if it has one.

The forms are described in docs/sensors.md. CDR is the plain OMG form that ROS 2 uses: a 4-byte encapsulation header
that says the byte order, then the fields, each aligned to its own size counted from behind the header.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from math import isfinite
from typing import Any, NamedTuple

import numpy as np

from duio_mesh.arrays import Array

ROS = ("std_msgs/Float64", "std_msgs/Float64MultiArray", "sensor_msgs/Temperature")
ENCODINGS = ("json", "float64", *ROS)
SCALAR = ("std_msgs/Float64", "sensor_msgs/Temperature")  # one number a message

ROOM, ROOM_PER_NUMBER = 4096, 64  # bytes that an honest message may have: names and layouts, and each number as text
GID = 16  # bytes of a ROS 2 publisher's id in an attachment


class Refused(ValueError):
    """Why a sample was dropped; ``cause`` is a few words, for counting."""

    def __init__(self, cause: str) -> None:
        super().__init__(cause)
        self.cause = cause


class Sample(NamedTuple):
    """One good message."""

    values: Array  # (size,), finite
    number: int | None  # None: the publisher does not count


def read(encoding: str, payload: bytes, attachment: bytes | None, size: int) -> Sample:
    """The ``size`` numbers of a message, and its number.

    Raises Refused when the bytes are not in this form, not so many numbers, or not finite; KeyError for an encoding
    that there is not.
    """
    decode = _DECODERS[encoding]
    if len(payload) > ROOM + ROOM_PER_NUMBER * size:
        raise Refused("too large")
    number = _attached(attachment)
    try:
        values, own = decode(payload)
        found = tuple(map(float, values))
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError, struct.error):
        raise Refused(f"not {encoding}") from None
    if len(found) != size:
        raise Refused(f"{len(found)} numbers instead of {size}")
    if not all(map(isfinite, found)):
        raise Refused("not finite")
    number = number if own is None else own
    if number is not None and number < 0:
        raise Refused("its number is negative")
    return Sample(np.array(found, dtype=np.float64), number)


def _attached(attachment: bytes | None) -> int | None:
    """The number in an attachment: 8 bytes, or the 33 of rmw_zenoh (number, time, length of the id, id)."""
    if not attachment:
        return None
    if len(attachment) == 8 or (len(attachment) == 17 + GID and attachment[16] == GID):
        return int.from_bytes(attachment[:8], "little", signed=True)
    raise Refused("an attachment that is not a number")


def _json(payload: bytes) -> tuple[list[Any], int | None]:
    """A number, a list of numbers, or {"y": numbers, "u": numbers, "k": number of the sample}."""
    said = json.loads(payload)
    if not isinstance(said, dict):
        return _listed(said), None
    k = said.get("k")
    if not said.keys() <= {"k", "y", "u"} or not (k is None or type(k) is int):
        raise ValueError
    return _listed(said["y"]) + _listed(said.get("u", [])), k


def _listed(said: Any) -> list[Any]:
    many = said if isinstance(said, list) else [said]
    if not all(type(value) in (int, float) for value in many):
        raise ValueError
    return many


def _float64(payload: bytes) -> tuple[list[Any], None]:
    return np.frombuffer(payload, dtype="<f8").tolist(), None


class _Cdr:
    """Reads fields in order; struct.error or ValueError where the bytes do not fit."""

    def __init__(self, data: bytes) -> None:
        """The encapsulation header: 00 00 for big-endian, 00 01 for little-endian, and two bytes of options."""
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            raise ValueError("not plain CDR")
        self._order = "<" if data[1] else ">"
        self._data, self._at = data[4:], 0

    def take(self, form: str, count: int = 1) -> tuple[Any, ...]:
        """``count`` numbers of one struct format."""
        width = struct.calcsize(form)
        self._at += -self._at % width
        if count * width > len(self._data) - self._at:  # before a format of any length is made of it
            raise ValueError("truncated")
        found = struct.unpack_from(f"{self._order}{count}{form}", self._data, self._at)
        self._at += count * width
        return found

    def text(self) -> None:
        """Skip a string: its length with the closing zero, then its bytes."""
        (length,) = self.take("I")
        self.take("B", length)

    def end(self) -> None:
        """Nothing may follow but padding to four bytes."""
        if len(self._data) - self._at > 3:
            raise ValueError("longer than it should be")


def _ros_float64(payload: bytes) -> tuple[tuple[Any, ...], None]:
    cdr = _Cdr(payload)
    data = cdr.take("d")
    cdr.end()
    return data, None


def _ros_array(payload: bytes) -> tuple[tuple[Any, ...], None]:
    """layout (dimensions with label, size and stride; data_offset), data."""
    cdr = _Cdr(payload)
    for _ in range(cdr.take("I")[0]):
        cdr.text()
        cdr.take("I", 2)
    if cdr.take("I") != (0,):
        raise ValueError("data_offset")
    (count,) = cdr.take("I")
    data = cdr.take("d", count) if count else ()
    cdr.end()
    return data, None


def _ros_temperature(payload: bytes) -> tuple[tuple[Any, ...], None]:
    """header (stamp, frame_id), temperature, variance."""
    cdr = _Cdr(payload)
    cdr.take("I", 2)
    cdr.text()
    temperature = cdr.take("d")
    cdr.take("d")
    cdr.end()
    return temperature, None


_DECODERS: dict[str, Callable[[bytes], tuple[Any, int | None]]] = {
    "json": _json,
    "float64": _float64,
    "std_msgs/Float64": _ros_float64,
    "std_msgs/Float64MultiArray": _ros_array,
    "sensor_msgs/Temperature": _ros_temperature,
}
