"""Exactly (k, r) from exactly this neighbour, or a clear end.

The hot path of a node. Each incoming link has a channel that Zenoh fills without Python, so a round costs one wake-up
per neighbour. A link delivers in order, so the next frame is nearly always the one that is due, and then comparing its
first bytes with the expected ones replaces reading them. A wait has no timeout of its own: a watchdog knocks on the
channel of a neighbour that has gone, or that let the deadline pass, and that ends the wait. A knock comes behind
everything that the neighbour had sent.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Mapping
from functools import cache
from math import isfinite
from struct import Struct
from types import TracebackType
from typing import NamedTuple, Self
from zlib import crc32

import numpy as np
import zenoh

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.mesh.frames import BIN8_OF_4, FLOAT64, RESIDUE, TAIL, Decoder, Frame, Rejected, prefix, stamp
from duio_mesh.mesh.session import Member, Mesh, Outlet, Ready, Source

ROOM = 4  # frames per step of the window that may wait
FEW = 48  # numbers
TICK = 0.1  # seconds between the watchdog's looks once somebody has gone; before, a quarter of what is soon
SOON, PART = 1.0, 0.25  # a wait is worth a word after so many seconds, or this part of the deadline


def soon(deadline: float) -> float:
    """Seconds after which a wait is worth a word."""
    return min(SOON, PART * deadline)


class LinkLost(RunError):
    """The other end of a link has gone."""


class Ended(Exception):
    """A patient line's sender has said that there will be no further step."""


class Form(NamedTuple):
    """What a payload of ``size`` numbers looks like."""

    size: int
    rest: int  # bytes from the payload's first to the frame's last
    finite: Callable[[bytes, int], bool]  # (frame, start): whether all numbers are; "no" may be wrong, see ``form``


@cache
def form(size: int) -> Form:
    """The form of payloads of this size.

    ``finite`` looks at one number only, the sum, or for many numbers the sum of 0 times each: whatever is not finite
    shows in it. A sum that overflows sends a good frame the long way, where it is looked at number by number.
    """
    unpack, zeros = Struct(f"<{size}d").unpack_from, np.zeros(size)
    if size <= FEW:  # a call into BLAS costs more than a few floats
        return Form(size, 8 * size + TAIL, lambda data, start: isfinite(sum(unpack(data, start))))
    return Form(
        size, 8 * size + TAIL, lambda data, start: isfinite(zeros.dot(np.frombuffer(data, FLOAT64, size, start)))
    )


class Line(Source):
    """One incoming link of a node."""

    patient = False  # its sender itself says when it has waited too long, and may end early by an empty frame

    def __init__(
        self, mesh: Mesh, key: str, name: str, who: str, ready: Ready | None, window: int, room: int = 0
    ) -> None:
        """``window``: steps that the sender may be ahead of us. ``room``: frames that may wait; 0: as below.

        A neighbour that hears us is never more than a round ahead, because its next round needs our present one. One
        that does not hear us (a directed edge) is held back only by its own neighbours and by the plant's window. The
        channel has room for that: a full one would hold up everything else that this process receives.
        """
        super().__init__(name, who, Decoder(mesh.keys.run, who))
        self.prefix = prefix(mesh.keys.run, who)
        self.waiting: dict[tuple[int, int], Array] = {}  # good frames that are not due yet
        self.excused: dict[tuple[int, int], bool] = {}  # faults on purpose: frames past due, to be kept or dropped
        self.window, self.room = window, room or ROOM * window
        self.late: object = None  # the wait in which it let the deadline pass
        handler = mesh.subscribe(key, zenoh.handlers.FifoChannel(self.room), ready).handler
        self.receive, self.poll = handler.recv, handler.try_recv
        self._mesh, self._key = mesh, key
        self.token = secrets.token_bytes(8)  # a knock: nobody else can know it
        mesh.sources.append(self)

    def expect(self, before: int) -> None:
        """The other end is the process that replaces so many others."""
        self.before, self.gone = before, False
        if not self._mesh.alive(Member(self.who, before)):  # a death before this look; a later one buries this line
            self.gone = True

    def knock(self) -> None:
        """Let ``receive`` return ``token``, after everything that has come."""
        self._mesh.tell_self(self._key, self.token)


class Lockstep:
    """Takes frames in order; a context manager around the time in which it may wait."""

    def __init__(
        self, mesh: Mesh, deadline: float, say: Callable[..., None] = lambda *_, **__: None, times: int = 1
    ) -> None:
        """``deadline``: seconds; any one wait may last ``times`` as long.

        ``say`` is called as say("waiting", on=, link=, k=, r=) when one lasts long, say("moving") when that is over.
        """
        self._mesh, self._deadline, self._say, self._soon = mesh, deadline * times, say, soon(deadline)
        self.first = 0  # earlier steps' frames were meant for a process before this one
        self._at: tuple[Line, int, int] | None = None  # what the main thread waits for
        self._news, self._over = threading.Event(), False
        self._tick = self._soon / 4
        self._watchdog = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> Self:
        self._watchdog.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._over = True
        self._news.set()
        self._watchdog.join()

    def take(self, line: Line, k: int, r: int, size: int) -> Array:
        """The vector (size,) of step k, round r from this line, waiting for it if need be.

        Raises RunError naming edge, step and round when it does not come before the deadline, or when the other side
        has gone.
        """
        return self.due(line, k, r, form(size), stamp(k, r, 8 * size))

    def due(self, line: Line, k: int, r: int, form: Form, mark: bytes) -> Array:
        """``take``, for a caller that asks many lines for the same thing; ``mark`` is its stamp on the wire."""
        expected = line.prefix + mark
        start, size = len(expected), form.size
        self._at = (line, k, r)
        while True:
            if line.waiting and (held := self._held(line, k, r, size)) is not None:
                line.last = (k, r)
                self._at = None
                return held
            data: bytes = line.receive().payload.to_bytes()
            if (
                data.startswith(expected)
                and len(data) == start + form.rest
                and data.startswith(BIN8_OF_4, -TAIL)
                and crc32(data) == RESIDUE
                and form.finite(data, start)
            ):
                line.last = (k, r)
                self._at = None
                return np.frombuffer(data, FLOAT64, size, start)
            if data == line.token:
                self._answer(line, k, r)
            else:
                self.set_aside(line, data, k, r)

    def next_of(self, line: Line, r: int) -> Frame:
        """The next frame of round r from this line, of whatever step and size; others are dropped. Raises as ``take``.

        For a process that does not know yet which step it is.
        """
        self._at = (line, 0, r)
        while True:
            data: bytes = line.receive().payload.to_bytes()
            if data == line.token:
                self._answer(line, 0, r)
                continue
            try:
                frame = line.decode(data)
            except Rejected as e:
                self._mesh.reject(line, e.cause)
                continue
            if frame.r == r:
                line.last = frame[:2]
                self._at = None
                return frame

    def _answer(self, line: Line, k: int, r: int) -> None:
        """A knock: of this wait, or of one that has ended well meanwhile."""
        if line.gone or line.late is self._at:
            self._at = None
            if line.gone:
                raise LinkLost(self._why(line, k, r), (line.who,))
            raise RunError(self._why(line, k, r))

    def _held(self, line: Line, k: int, r: int, size: int) -> Array | None:
        """The frame of step k, round r, if it came before it was due and has the right size."""
        vector = line.waiting.pop((k, r), None)
        if line.patient and vector is not None and not vector.size:
            raise Ended
        if vector is not None and vector.size != size:
            self._mesh.reject(line, f"{vector.size} numbers instead of {size}")
            return None
        return vector

    def set_aside(self, line: Line, data: bytes, k: int, r: int) -> None:
        """A frame that is not simply the next one: keep it for later, or count it and drop it."""
        try:
            frame = line.decode(data)
        except Rejected as e:
            self._mesh.reject(line, e.cause)
            return
        if frame.k < self.first:
            return
        kept = line.excused.pop(frame[:2], None)
        if kept is not None:
            if kept:
                line.waiting[frame[:2]] = frame.vector
        elif frame[:2] < (k, r) or frame[:2] in line.waiting:
            self._mesh.reject(line, "seen before")
        elif frame.k - k > line.window or len(line.waiting) >= line.room:
            self._mesh.reject(line, "too far ahead")
        else:
            line.waiting[frame[:2]] = frame.vector

    def _why(self, line: Line, k: int, r: int) -> str:
        if line.gone:
            return f"{self._mesh.who} lost {line.who} while waiting on {line.name} for step {k}, round {r}"
        return f"{self._mesh.who} waited {self._deadline:g} s on {line.name} for step {k}, round {r}: {line.doing()}"

    def noticed(self, member: Member, alive: bool) -> None:
        """A directly linked process came or went (``Mesh.watch``)."""
        if not alive:
            self._mesh.bury(member)
            self._tick = min(TICK, self._tick)
            self._news.set()

    def _watch(self) -> None:
        """Say which waits last long, and end those that cannot end well."""
        seen, since, told = None, time.monotonic(), False
        while not self._over:
            self._news.wait(self._tick)
            self._news.clear()
            at, now = self._at, time.monotonic()
            if at is not seen:
                if told:
                    self._say("moving")
                seen, since, told = at, now, False
            if not at:
                continue
            line, k, r = at
            if now - since > self._soon and not told:
                told = True
                self._say("waiting", on=[line.who], link=line.name, k=k, r=r, waited=now - since)
            if now - since > self._deadline and not line.patient:
                line.late = at
            if line.gone or line.late is at:
                line.knock()


class Exchange:
    """One node's rounds with its neighbours."""

    def __init__(self, lockstep: Lockstep, told: Outlet, heard: Mapping[int, Line]) -> None:
        self._due, self._send = lockstep.due, told.send
        self._heard = sorted(heard.items())

    def __call__(self, k: int, r: int, vector: Array) -> dict[int, Array]:
        """Send our vector of step k, round r; every neighbour's vector of the same round, in ascending order of id."""
        self._send(k, r, vector)
        due, wanted, mark = self._due, form(vector.size), stamp(k, r, 8 * vector.size)
        return {j: due(line, k, r, wanted, mark) for j, line in self._heard}
