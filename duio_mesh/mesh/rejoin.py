"""How a process that replaces a lost node gets back into step.

The plant settles it, because nobody can have passed a step whose sample it has not sent. The new process asks it; at
its next block of samples, of steps B, B+1, ..., the plant tells everybody, ahead of that block and on the same keys,
that the node takes part from step B on. The neighbours that tell it something send their estimates of x(B-1) before
their first message of step B; from these and its own sample of step B-1 it starts.

| key | round | what |
|---|---|---|
| credit/<i> | ``ASK`` | from the new process, k = how many processes of this node were there before |
| plant/<j> | ``JOINED`` | at step k come back: rows [node, processes before], to everybody |
| plant/<i> | ``AWAY``, ``YOURS`` | to those who come back: who is not there, and [y; u](k-1) or nothing when k = 0 |
| edge/<j>/<i> | ``HELLO`` | x-hat_j(k-1), and 1 when that is not to be trusted |
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.mesh.frames import LIMIT
from duio_mesh.mesh.lockstep import Line, Lockstep
from duio_mesh.mesh.session import Outlet

ASK = AWAY = 1
JOINED, YOURS = 2, 3
HELLO = LIMIT - 1

NO_VECTOR = np.zeros(0)


class Admission(NamedTuple):
    """What the plant tells a node that comes back."""

    first: int  # the step B from which on it takes part
    data: Array  # its own sample [y; u](B-1); empty when B = 0
    joined: Mapping[int, int]  # who comes back at B, itself included: node -> processes before
    away: tuple[int, ...]  # nodes that are not there


def ask(lockstep: Lockstep, plant: Line, credit: Outlet, node: int, incarnation: int) -> Admission:
    """Ask to take part again, and wait for the answer. Raises RunError when the plant is lost or silent.

    An answer to the process before this one, which was lost while it waited, is passed over.
    """
    credit.send(incarnation, ASK, NO_VECTOR)
    while True:
        away = lockstep.next_of(plant, AWAY).vector
        joined = lockstep.next_of(plant, JOINED)
        data = lockstep.next_of(plant, YOURS).vector
        if (back := come_back(joined.vector)).get(node) == incarnation:
            return Admission(joined.k, data, back, tuple(int(i) for i in away))


def come_back(rows: Array) -> dict[int, int]:
    """The payload of ``JOINED``: node -> processes of it before, in ascending order of id."""
    return {int(i): int(before) for i, before in rows.reshape(-1, 2)}


def admit(
    outlets: Mapping[int, Outlet], k: int, back: Mapping[int, int], away: Collection[int], before: Mapping[int, Array]
) -> None:
    """The plant's answer at step k to all in ``back``, and what everybody else needs to know."""
    rows = np.array([[i, back[i]] for i in sorted(back)], dtype=np.float64)
    for i, outlet in outlets.items():
        if i in back:
            outlet.send(k, AWAY, np.array(sorted(set(away) - back.keys()), dtype=np.float64))
        outlet.send(k, JOINED, rows)
        if i in back:
            outlet.send(k, YOURS, before.get(i, NO_VECTOR))
