"""A node's rounds with its neighbours when messages can be missing.

Because faults are made on purpose (``duio_mesh.faults``). Every frame is really sent: the sender flips the bits that
are to be flipped and sends twice what is to come twice; which frames are lost or late the receiver decides, and it
never waits for one that the model keeps from it. Or because a neighbour is gone: then its edge is left out until it
comes back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

from duio_mesh.arrays import Array
from duio_mesh.faults import Reception, Stamp
from duio_mesh.mesh.lockstep import Line, LinkLost, Lockstep
from duio_mesh.mesh.session import Outlet
from duio_mesh.mesh.spoiler import Spoiler
from duio_mesh.spec import NodeSpec

LONG_WAY = 1_000_000
"""Frames that may wait on one edge. Only the plant's window holds back a neighbour that we do not wait for, so it may
be that many steps of all their rounds ahead; and a channel that is full would hold up the plant's frames as well."""

Arrived = tuple[Stamp, Array]


class Told(Protocol):
    """Whoever wants to know what happens beside the rounds."""

    def late(self, k: int, arrived: Sequence[Arrived]) -> None:
        """Older frames arrive in the coming round of step k."""
        ...

    def lost(self, j: int, k: int, r: int, why: str) -> None:
        """Neighbour j is gone; ``why`` is empty when that was planned."""
        ...


class FaultyExchange:
    """In place of ``Exchange``: the same call, with neighbours missing in what it returns."""

    def __init__(
        self, spec: NodeSpec, lockstep: Lockstep, told: Outlet, heard: Mapping[int, Line], listener: Told
    ) -> None:
        self._lockstep, self._tell, self._listener = lockstep, Spoiler(spec, told), listener
        self._heard = dict(sorted(heard.items()))
        self._endures = spec.on_loss != "stop"
        self._reception = Reception(spec.faults, spec.hears)
        self._parted: set[int] = set()  # who is gone, planned or not
        self._sizes: dict[Stamp, int] = {}  # of frames on their long way

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames of the in-edges, by what the model did to them."""
        return self._reception.counts

    def __call__(self, k: int, r: int, vector: Array) -> dict[int, Array]:
        """Send our vector of step k, round r; those of the same round that arrive in time, in ascending order of id."""
        self._tell(k, r, vector)
        for j in self._heard:
            if j not in self._parted and self._reception.without(j, k):
                self._part(j, k, r, "")
        on_time, held, lost, late = self._reception.next(k, r)
        size = vector.size
        for j in held:
            self._sizes[Stamp(j, k, r)] = size
            if (k, r) not in self._heard[j].waiting:
                self._heard[j].excused[k, r] = True
        for j in lost:
            if self._heard[j].waiting.pop((k, r), None) is None:
                self._heard[j].excused[k, r] = False
        if late:
            older = {stamp: self._take(stamp, self._sizes.pop(stamp), (k, r)) for stamp in late}
            self._listener.late(k, [(stamp, found) for stamp, found in older.items() if found is not None])
        taken = {j: self._take(Stamp(j, k, r), size, (k, r)) for j in on_time}
        received = {j: found for j, found in taken.items() if found is not None}
        for j, line in self._heard.items():
            if j not in received:
                self._read_past(line, k, r)
        return received

    def expects(self, j: int, k: int) -> bool:
        """Whether somebody is to be at in-neighbour j's end in step k."""
        return not self._reception.without(j, k)

    def lose(self, j: int, k: int, r: int, why: str) -> None:
        """Do without in-neighbour j until ``welcome``."""
        self._reception.gone.add(j)
        self._give_up(j, k, r)
        if j not in self._parted:
            self._part(j, k, r, why)

    def welcome(self, j: int, k: int) -> None:
        """In-neighbour j is there again; to be waited for from the coming step k on."""
        self._parted.discard(j)
        self._reception.gone.discard(j)
        self._give_up(j, k, 0)  # where all its frames come late, nobody may have missed the process before this one

    def _give_up(self, j: int, k: int, r: int) -> None:
        """Expect no late frames of a dead process but those that it has sent, which are all here."""
        line = self._heard[j]
        self._read_past(line, k, r)
        for stamp in self._reception.give_up(j, line.waiting):
            del self._sizes[stamp]
            line.excused.pop((stamp.k, stamp.r), None)

    def _part(self, j: int, k: int, r: int, why: str) -> None:
        self._parted.add(j)
        self._listener.lost(j, k, r, why)

    def _take(self, stamp: Stamp, size: int, at: tuple[int, int]) -> Array | None:
        """The frame, or None when its sender is gone."""
        try:
            return self._lockstep.take(self._heard[stamp.source], stamp.k, stamp.r, size)
        except LinkLost as e:
            if not self._endures:
                raise
            self.lose(stamp.source, *at, str(e))
            return None

    def _read_past(self, line: Line, k: int, r: int) -> None:
        """Take what has come on a line that we do not wait for."""
        while (sample := line.poll()) is not None:
            if (data := sample.payload.to_bytes()) != line.token:
                self._lockstep.set_aside(line, data, k, r)
