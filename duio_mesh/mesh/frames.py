"""Frames: one msgpack array ``[version, run, source, k, r, payload, checksum]`` of a fixed, canonical layout.

Any msgpack library reads a frame; this module writes and reads it by offsets, because the integers always take their
five-byte form. A frame that is not byte for byte in that form, from that source and of that run is refused, and the
checksum (crc32 of everything before it) makes a flipped bit a refusal, too. Nothing is ever unpickled.
"""

from __future__ import annotations

import struct
from typing import NamedTuple
from zlib import crc32

import msgpack
import numpy as np

from duio_mesh.arrays import Array

VERSION = 1
LIMIT = 1 << 32  # steps and rounds are unsigned 32-bit on the wire

_STAMP = struct.Struct(">BIBI")  # uint32 k, uint32 r in msgpack's 0xce form
_UINT32 = 0xCE
_CHECK = struct.Struct(">HI")  # bin8 of four bytes: the checksum
_BIN8_OF_4 = 0xC404
_BIN_HEADERS = ((0xC4, ">BB", 1 << 8), (0xC5, ">BH", 1 << 16), (0xC6, ">BI", 1 << 32))


class Frame(NamedTuple):
    """One message: step, round, and the float64 vector (read-only, owned by the frame)."""

    k: int
    r: int
    vector: Array


class Rejected(ValueError):
    """Why a frame was dropped; ``cause`` is one of a few words, for counting."""

    def __init__(self, cause: str) -> None:
        super().__init__(cause)
        self.cause = cause


def prefix(run: str, source: str) -> bytes:
    """The constant first bytes of every frame of this source in this run."""
    return b"\x97" + b"".join(msgpack.packb(field) for field in (VERSION, run, source))


def _bin_header(size: int) -> bytes:
    for code, form, limit in _BIN_HEADERS:
        if size < limit:
            return struct.pack(form, code, size)
    raise ValueError(f"a frame cannot carry {size} bytes")


class Encoder:
    """Writes the frames of one source."""

    def __init__(self, run: str, source: str) -> None:
        self._prefix = prefix(run, source)
        self._headers: dict[int, bytes] = {}

    def __call__(self, k: int, r: int, vector: Array) -> bytes:
        """The frame of step k, round r."""
        payload = vector.tobytes() if vector.dtype.str == "<f8" else vector.astype("<f8").tobytes()
        size = len(payload)
        header = self._headers.get(size) or self._headers.setdefault(size, _bin_header(size))
        body = self._prefix + _STAMP.pack(_UINT32, k, _UINT32, r) + header + payload
        return body + _CHECK.pack(_BIN8_OF_4, crc32(body))


def decode(data: bytes, expected: bytes) -> Frame:
    """Read a frame whose constant part must be ``expected`` (see ``prefix``).

    Raises Rejected for anything that ``Encoder`` would not have written: truncation, another version, run or source,
    a wrong checksum, a payload that is not whole float64 numbers or not finite.
    """
    at = len(expected)
    if not data.startswith(expected):
        raise Rejected("not from the expected source, run and version")
    end = len(data) - _CHECK.size
    head = at + _STAMP.size
    if end < head + 2:
        raise Rejected("truncated")
    mark, check = _CHECK.unpack_from(data, end)
    if mark != _BIN8_OF_4 or check != crc32(memoryview(data)[:end]):
        raise Rejected("checksum")
    k_form, k, r_form, r = _STAMP.unpack_from(data, at)
    code = data[head]
    start = head + (2 if code == 0xC4 else 3 if code == 0xC5 else 5)
    size = end - start
    if k_form != _UINT32 or r_form != _UINT32 or size < 0 or size % 8 or data[head:start] != _bin_header(size):
        raise Rejected("layout")
    vector = np.frombuffer(data, dtype="<f8", count=size // 8, offset=start)
    if not np.isfinite(vector).all():
        raise Rejected("not finite")
    return Frame(k, r, vector)
