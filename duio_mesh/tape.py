"""The tape: every call that a node's observer was given, in order; enough to run that observer again alone.

A tape is a msgpack stream of arrays whose first element says what they are. Vectors are little-endian float64 bytes.

    [0, length, crc32]                          a chunk: so many bytes of records follow, with this checksum
    [1, "duio_mesh tape", version, node, incarnation, first, steps, made]
                                                a process begins: its first step and how many there are from there on;
                                                ``made`` says what of (run, versions, spec)
    [2, y, u]                                   ``sample``
    [3, r, {neighbour: vector}]                 ``exchange``
    [4, [[source, steps, round, vector], ...]]  ``late``: vectors that come later than their own exchange
    [5]                                         the estimates of all samples since the last [5] are read
    [6, name, arguments]                        another call, one of ``CALLS``

A chunk is written whole, every ``PERIOD`` seconds or ``FULL`` bytes, whichever comes first. So kill -9 costs no more
than the last hundredth of a second, and at most 64 KiB. A call is noted before it is carried out: what made an observer
raise an error is there.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import struct
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, Self, TypeAlias
from zlib import crc32

import msgpack
import numpy as np

from duio_mesh import __version__
from duio_mesh.arrays import Array
from duio_mesh.observers.absence import Late
from duio_mesh.observers.base import Estimate, Observer
from duio_mesh.spec import NodeSpec, packed

VERSION = 1
MAGIC = "duio_mesh tape"
PERIOD = 0.01  # seconds between chunks
FULL = 1 << 16  # bytes
CALLS = frozenset({"part_with", "welcome", "resume", "distrust", "mistrust"})
"""Calls beyond the step machine's own that change an observer. A tape holds no others."""
LOOKS = frozenset({"watched"})  # calls that change nothing that an estimate depends on

MANY = 1 << 20  # vectors in a record

_CHUNK = struct.Struct(">BBBIBI")  # [0, uint32, uint32] in msgpack's fixed form
_ARRAY_OF_3, _UINT32 = 0x93, 0xCE
_FLOAT64 = np.dtype("<f8")


class _Kind:
    CHUNK, HEAD, SAMPLE, EXCHANGE, LATE, READ, CALL = range(7)


class Head(NamedTuple):
    """A process begins."""

    node: int
    incarnation: int  # processes of this node that were there before
    first: int  # its first step
    steps: int  # from there to the end of the run
    made: Mapping[str, str]  # what it was made of: differing there explains differing bits


class Sample(NamedTuple):
    """y_i(k) (p,) and u_i(k) (m,)."""

    y: Array
    u: Array


class Exchange(NamedTuple):
    """The vectors of round r that came, by neighbour."""

    r: int
    received: Mapping[int, Array]


class Arrival(NamedTuple):
    """Vectors of earlier exchanges, handed over before the next one."""

    late: tuple[Late, ...]


class Read(NamedTuple):
    """The estimates are read: a step, or a batch of them, is done."""


class Call(NamedTuple):
    """A call of ``CALLS``."""

    name: str
    arguments: tuple[Any, ...]  # whole numbers and vectors


Record: TypeAlias = Head | Sample | Exchange | Arrival | Read | Call


def ingredients(spec: NodeSpec) -> dict[str, str]:
    """What the bits of an estimate depend on besides the tape, in words that can be compared."""
    parts = (spec.method, spec.n, spec.p, spec.m, spec.matrices, spec.options, spec.hears, spec.batch, spec.without)
    digest = hashlib.sha256(packed(list(parts))).hexdigest()
    machine = os.uname().machine
    return {"run": spec.wire.run, "duio_mesh": __version__, "numpy": np.__version__, "machine": machine, "spec": digest}


class Tape:
    """The tape of one process, where its spec asks for one; a context manager that flushes and closes."""

    def __init__(self, spec: NodeSpec) -> None:
        """Begin a tape, or go on with the one that an earlier process of this node left. Mode 0600, like the spec.

        Raises ValueError when the file is not a tape, OSError when it cannot be written.
        """
        self._spec = spec
        self._file = _open(Path(spec.inputs)) if spec.inputs else None
        self._pack = msgpack.Packer().pack
        self._buffer, self._due = bytearray(), 0.0

    def follow(self, observer: Observer, first: int = 0, incarnation: int = 0) -> Observer:
        """The observer, each of whose calls is noted from now on; without a tape the observer itself.

        ``first``: the step of the first ``sample`` to come; ``incarnation``: how many processes of this node, which
        wrote to the same file, there were before this one.
        """
        if self._file is None:
            return observer
        spec = self._spec
        return Taped(observer, self, Head(spec.id, incarnation, first, spec.steps - first, ingredients(spec)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.flush()
        if self._file:
            self._file.close()

    def write(self, record: tuple[Any, ...]) -> None:
        """Append a record of plain data."""
        self._buffer += self._pack(record)
        if len(self._buffer) >= FULL or time.monotonic() >= self._due:
            self.flush()

    def flush(self) -> None:
        """Hand a chunk to the operating system, where it outlives this process."""
        self._due = time.monotonic() + PERIOD
        if self._buffer and self._file:
            chunk, self._buffer = self._buffer, bytearray()  # who stops us now shall not write it once more
            self._file.write(_CHUNK.pack(*_chunk_of(chunk)) + chunk)
            self._file.flush()


class Taped:
    """An observer with a tape: each call is written down, then carried out by the observer itself."""

    def __init__(self, inner: Observer, tape: Tape, head: Head) -> None:
        """``head`` is written with the first call, so that an observer that is never used leaves nothing."""
        self._inner, self._tape, self._head = inner, tape, head
        self._write = self._begin
        self._sample, self._exchange = inner.sample, inner.exchange
        self._unread, self._r = False, -1  # since the estimates were last read: whether there are samples; last round
        self.message = inner.message

    @property
    def rounds(self) -> int:
        """As the observer has."""
        return self._inner.rounds

    def sample(self, y: Array, u: Array) -> None:
        """As the observer does."""
        self._unread, self._r = True, -1
        self._write((_Kind.SAMPLE, _bytes(y), _bytes(u)))
        self._sample(y, u)

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """As the observer does."""
        self._r = r
        self._write((_Kind.EXCHANGE, r, {j: _bytes(vector) for j, vector in received.items()}))
        self._exchange(r, received)

    def estimate(self) -> Estimate:
        """As the observer has."""
        self._note_reading()
        return self._inner.estimate()

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """As the observer does."""
        self._called("resume", getattr(self._inner, "resume"), x, y, u)  # noqa: B009

    def __getattr__(self, name: str) -> Any:
        """What only some observers have.

        Raises TypeError for a call that is not one of ``CALLS``: left out, the tape would not lead to the same bits.
        """
        inner = getattr(self._inner, name)
        if not callable(inner) or name in LOOKS:
            return inner
        if name == "late":
            return partial(self._late, inner)
        if name == "batch":
            return partial(self._batch, inner)
        if name in CALLS:
            return partial(self._called, name, inner)
        raise TypeError(f"a tape has no record for the observer's call {name!r}; name it in duio_mesh.tape.CALLS")

    def _begin(self, record: tuple[Any, ...]) -> None:
        """Write the first record, after the head."""
        head = self._head
        self._write = self._tape.write
        self._write((_Kind.HEAD, MAGIC, VERSION, *head[:4], dict(head.made)))
        self._write(record)

    def _note_reading(self) -> None:
        """Only what is read after the last round is new; who asks for an estimate in between gets an old one."""
        if self._unread and self._r + 1 >= self._inner.rounds:
            self._unread = False
            self._write((_Kind.READ,))

    def _batch(self, inner: Callable[[], Sequence[Estimate]]) -> Sequence[Estimate]:
        self._note_reading()
        return inner()

    def _late(self, inner: Callable[[Sequence[Late]], None], arrived: Sequence[Late]) -> None:
        self._write((_Kind.LATE, [(j, steps, r, _bytes(vector)) for j, steps, r, vector in arrived]))
        inner(arrived)

    def _called(self, name: str, inner: Callable[..., None], *arguments: Array | int) -> None:
        plain = [_bytes(a) if isinstance(a, np.ndarray) else int(a) for a in arguments]
        self._write((_Kind.CALL, name, plain))
        inner(*arguments)


def read_tape(path: Path) -> Iterator[Record]:
    """The records of a tape, up to the last whole one.

    Raises ValueError, at the place, where the file is not a tape or is damaged, OSError when it cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        known = False
        while (begin := file.tell()) < size:
            for fields in _records(file, path).whole:
                record = _record(fields, path, begin)
                if not known and not isinstance(record, Head):
                    raise ValueError(f"{path} is not a tape: it does not begin with a head")
                known = True
                yield record
        if not known:
            raise ValueError(f"{path} is empty: the process ended before it had written anything")


class _Chunk(NamedTuple):
    """A chunk as it is in the file."""

    whole: list[Any]  # the fields of its whole records
    used: int  # bytes that these take


def _length(file: BinaryIO, path: Path) -> tuple[int, int]:
    """(bytes, checksum) of the records of the chunk that starts here; no bytes where its head is cut short."""
    begin, head = file.tell(), file.read(_CHUNK.size)
    if len(head) < _CHUNK.size:
        return 0, 0
    form, kind, length_form, length, crc_form, crc = _CHUNK.unpack(head)
    if (form, kind, length_form, crc_form) != (_ARRAY_OF_3, _Kind.CHUNK, _UINT32, _UINT32):
        raise ValueError(f"{path} is not a tape, or is damaged at byte {begin}")
    return length, crc


def _records(file: BinaryIO, path: Path) -> _Chunk:
    """The records of the chunk that starts here. Only at the end of the file may it be cut short."""
    begin = file.tell()
    length, crc = _length(file, path)
    data = file.read(length)
    complete = len(data) == length
    if complete and crc32(data) != crc:
        raise ValueError(f"{path} is damaged between bytes {begin} and {file.tell()}: wrong checksum")
    most = max(1, length)  # of what a record that is cut short may say of itself
    unpacker = msgpack.Unpacker(use_list=False, strict_map_key=False, max_buffer_size=most, max_array_len=MANY)
    unpacker.feed(data)
    whole, used = [], 0
    try:
        for fields in unpacker:
            whole.append(fields)
            used = unpacker.tell()
    except (ValueError, msgpack.UnpackException) as e:
        raise ValueError(f"{path} is damaged after byte {begin + _CHUNK.size + used}: {e}") from None
    if complete and used != length:
        raise ValueError(f"{path} is damaged after byte {begin + _CHUNK.size + used}: half a record")
    return _Chunk(whole, used)


def _open(path: Path) -> BinaryIO:
    """The file, made if need be, for a process to go on at its end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "r+b")
    try:
        _repair(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _repair(file: BinaryIO, path: Path) -> None:
    """Go to the end, for a new process to go on there; a last chunk that was cut short ends with its last record."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    while (begin := file.tell()) < size:
        length, _ = _length(file, path)
        if begin + _CHUNK.size + length <= size:
            file.seek(length, os.SEEK_CUR)
            continue
        file.seek(begin)
        used = _records(file, path).used
        file.seek(begin + _CHUNK.size)
        data = file.read(used)
        file.seek(begin)
        file.truncate()
        if data:
            file.write(_CHUNK.pack(*_chunk_of(data)) + data)
        return


def _chunk_of(data: bytes | bytearray) -> tuple[int, ...]:
    return _ARRAY_OF_3, _Kind.CHUNK, _UINT32, len(data), _UINT32, crc32(data)


def _record(fields: Any, path: Path, begin: int) -> Record:
    """The record that these fields make. Raises ValueError for anything that ``Tape`` does not write."""
    with contextlib.suppress(ValueError, TypeError, AttributeError, OverflowError):
        match fields:
            case (_Kind.SAMPLE, bytes(y), bytes(u)):
                return Sample(_vector(y), _vector(u))
            case (_Kind.EXCHANGE, int(r), dict(received)):
                return Exchange(r, {int(j): _vector(v) for j, v in received.items()})
            case (_Kind.LATE, tuple(late)):
                return Arrival(tuple(Late(int(j), int(steps), int(r), _vector(v)) for j, steps, r, v in late))
            case (_Kind.READ,):
                return Read()
            case (_Kind.CALL, str(name), tuple(arguments)) if name in CALLS:
                return Call(name, tuple(_vector(a) if isinstance(a, bytes) else int(a) for a in arguments))
            case (_Kind.HEAD, str(magic), int(version), *rest) if magic == MAGIC:
                return _head(version, *rest)
    raise ValueError(f"{path} is not a tape that this version reads: unknown record in the chunk at byte {begin}")


def _head(version: int, node: int, incarnation: int, first: int, steps: int, made: Mapping[str, str]) -> Head:
    if version != VERSION:
        raise ValueError
    return Head(int(node), int(incarnation), int(first), int(steps), {str(k): str(v) for k, v in made.items()})


def _bytes(vector: Array) -> bytes:
    return vector.astype(_FLOAT64, copy=False).tobytes()


def _vector(data: bytes) -> Array:
    return np.frombuffer(data, _FLOAT64)
