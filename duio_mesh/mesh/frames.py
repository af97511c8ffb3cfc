"""Frames: one msgpack array ``[version, run, source, k, r, payload, checksum]`` of a fixed, canonical layout.

Any msgpack library reads a frame; this module writes and reads it by offsets, because the integers always take their
five-byte form. A frame that is not byte for byte in that form, from that source and of that run is refused, and the
checksum (crc32 of all bytes before it, least significant byte first) makes a flipped bit a refusal, too. Nothing is
ever unpickled.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from math import isfinite
from typing import NamedTuple
from zlib import crc32

import msgpack
import numpy as np

from duio_mesh.arrays import Array

VERSION = 1
LIMIT = 1 << 32  # steps and rounds are unsigned 32-bit on the wire

FLOAT64 = np.dtype("<f8")
RESIDUE = 0x2144DF1C  # crc32 of anything that ends with its own crc32, least significant byte first
TAIL = 6  # bytes of the checksum element: bin8, its length, the checksum

_STAMP = struct.Struct(">BIBI")  # uint32 k, uint32 r in msgpack's 0xce form
_UINT32 = 0xCE
BIN8_OF_4 = b"\xc4\x04"  # what stands before the checksum
_CHECK = struct.Struct("<I")
_LAYOUTS = 16  # frame lengths that a decoder remembers
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


@lru_cache(maxsize=16)  # a node uses very few payload sizes, and all neighbours the same step and round
def stamp(k: int, r: int, size: int) -> bytes:
    """What stands between the prefix and a payload of ``size`` bytes: step, round, and the payload's header."""
    return _STAMP.pack(_UINT32, k, _UINT32, r) + _bin_header(size)


def _bin_header(size: int) -> bytes:
    for code, form, limit in _BIN_HEADERS:
        if size < limit:
            return struct.pack(form, code, size)
    raise ValueError(f"a frame cannot carry {size} bytes")


class Encoder:
    """Writes the frames of one source."""

    def __init__(self, run: str, source: str) -> None:
        self._prefix = prefix(run, source)

    def __call__(self, k: int, r: int, vector: Array) -> bytes:
        """The frame of step k, round r; ``vector`` is little-endian float64 (a block of rows goes row by row)."""
        payload = vector.tobytes()
        body = self._prefix + stamp(k, r, len(payload)) + payload + BIN8_OF_4
        return body + _CHECK.pack(crc32(body))


class Decoder:
    """Reads the frames of one source of one run."""

    def __init__(self, run: str, source: str) -> None:
        self._prefix = prefix(run, source)
        self._layouts: dict[int, _Layout] = {}  # by length of the frame

    def __call__(self, data: bytes) -> Frame:
        """Read one frame.

        Raises Rejected for anything that ``Encoder`` would not have written: truncation, another version, run or
        source, a wrong checksum, a payload that is not whole float64 numbers or not finite.
        """
        layout = self._layouts.get(len(data)) or self._learn(data)
        front, k_form, k, r_form, r, header = layout.head.unpack_from(data)
        if front != self._prefix:
            raise Rejected("not from the expected source, run and version")
        if crc32(data) != RESIDUE:
            raise Rejected("checksum")
        end = layout.start + 8 * layout.numbers
        if k_form != _UINT32 or r_form != _UINT32 or header != layout.header or data[end : end + 2] != BIN8_OF_4:
            raise Rejected("layout")
        if not all(map(isfinite, layout.payload.unpack_from(data, layout.start))):
            raise Rejected("not finite")
        return Frame(k, r, np.frombuffer(data, FLOAT64, layout.numbers, layout.start))

    def _learn(self, data: bytes) -> _Layout:
        """The layout of frames of this length; a length that no payload gives is refused."""
        if not data.startswith(self._prefix):
            raise Rejected("not from the expected source, run and version")
        head = len(self._prefix) + _STAMP.size
        rest = len(data) - head - TAIL
        for code, form, limit in _BIN_HEADERS:
            size = rest - struct.calcsize(form)
            if 0 <= size < limit and size % 8 == 0 and _bin_header(size)[0] == code:
                break
        else:
            raise Rejected("truncated")
        header = _bin_header(size)
        layout = _Layout(
            head=struct.Struct(f">{len(self._prefix)}sBIBI{len(header)}s"),
            header=header,
            start=head + len(header),
            numbers=size // 8,
            payload=struct.Struct(f"<{size // 8}d"),
        )
        if len(self._layouts) < _LAYOUTS:  # who sends frames of every length shall not fill our memory
            self._layouts[len(data)] = layout
        return layout


class _Layout(NamedTuple):
    """Where everything is in a frame of one length."""

    head: struct.Struct  # prefix, k, r, header of the payload
    header: bytes
    start: int  # of the payload
    numbers: int
    payload: struct.Struct
