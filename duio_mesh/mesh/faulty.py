"""A node's rounds with its neighbours when faults are made on purpose (``duio_mesh.faults``).

Every frame is really sent. The sender flips the bits that are to be flipped and sends twice what is to come twice;
which frames are lost or late the receiver decides, and it never waits for one that the model keeps from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import zenoh

from duio_mesh.arrays import Array
from duio_mesh.faults import Reception, Stamp
from duio_mesh.mesh.lockstep import Line, Lockstep
from duio_mesh.mesh.session import Outlet
from duio_mesh.mesh.spoiler import Spoiler
from duio_mesh.spec import NodeSpec

LONG_WAY = 1_000_000
"""Frames that may wait on one edge. Only the plant's window holds back a neighbour that we do not wait for, so it may
be that many steps of all their rounds ahead; and a channel that is full would hold up the plant's frames as well."""

Arrived = tuple[Stamp, Array]


class FaultyExchange:
    """In place of ``Exchange``: the same call, with neighbours missing in what it returns."""

    def __init__(
        self,
        spec: NodeSpec,
        lockstep: Lockstep,
        told: Outlet,
        heard: Mapping[int, Line],
        late: Callable[[int, Sequence[Arrived]], None],
    ) -> None:
        """``late`` is called as late(k, [(stamp, vector), ...]) before the round in which older frames arrive."""
        self._lockstep, self._tell, self._late = lockstep, Spoiler(spec, told), late
        self._heard = dict(sorted(heard.items()))
        self._reception = Reception(spec.faults, spec.hears)
        self._sizes: dict[Stamp, int] = {}  # of frames on their long way

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames of the in-edges, by what the model did to them."""
        return self._reception.counts

    def __call__(self, k: int, r: int, vector: Array) -> dict[int, Array]:
        """Send our vector of step k, round r; those of the same round that arrive in time, in ascending order of id."""
        self._tell(k, r, vector)
        on_time, held, lost, late = self._reception.next(k, r)
        take, size = self._lockstep.take, vector.size
        for j in held:
            self._sizes[Stamp(j, k, r)] = size
            if (k, r) not in self._heard[j].waiting:
                self._heard[j].excused[k, r] = True
        for j in lost:
            if self._heard[j].waiting.pop((k, r), None) is None:
                self._heard[j].excused[k, r] = False
        if late:
            self._late(k, [(s, take(self._heard[s.source], s.k, s.r, self._sizes.pop(s))) for s in late])
        received = {j: take(self._heard[j], k, r, size) for j in on_time}
        for j, line in self._heard.items():
            if j not in received:
                self._read_past(line, k, r)
        return received

    def _read_past(self, line: Line, k: int, r: int) -> None:
        """Take what has come on a line that we do not wait for."""
        while True:
            try:
                sample = line.poll()
            except zenoh.ZError:  # closed
                return
            if sample is None:
                return
            self._lockstep.set_aside(line, sample.payload.to_bytes(), k, r)
