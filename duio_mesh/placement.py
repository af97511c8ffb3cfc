"""Which core a node's process stays on where many nodes share few cores: neighbours together.

Left to itself the kernel moves crowded processes about, and nearly every message crosses cores. With each core keeping
a connected part of the graph only the edges between two parts do. Few nodes are left to the kernel: pinned, they could
not get out of the way of whatever else the machine does.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

CROWD = 8  # nodes per core from which on every node gets a core of its own part


def cores(neighbours: Mapping[int, Sequence[int]], available: Sequence[int]) -> dict[int, int]:
    """Node id -> core, parts of about equal size; empty where the nodes are few or there is no choice.

    ``neighbours``: of every node, both ways. ``available``: cores that this process may use.
    """
    if len(available) < 2 or len(neighbours) < CROWD * len(available):
        return {}
    order = _along(neighbours)
    return {i: available[at * len(available) // len(order)] for at, i in enumerate(order)}


def available() -> list[int]:
    """Cores that this process may use; none where the system has no such thing."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def _along(neighbours: Mapping[int, Sequence[int]]) -> list[int]:
    """All nodes, island by island, in the order of their distance from one at an end: cut anywhere, few edges cross."""
    order: list[int] = []
    left = set(neighbours)
    while left:
        island = _outward(neighbours, min(left))
        order += _outward(neighbours, island[-1])  # from a node that is far from the first
        left.difference_update(island)
    return order


def _outward(neighbours: Mapping[int, Sequence[int]], start: int) -> list[int]:
    found = [start]
    seen = {start}
    for i in found:  # grows while we go
        fresh = [j for j in sorted(neighbours[i]) if j not in seen]
        seen.update(fresh)
        found += fresh
    return found
