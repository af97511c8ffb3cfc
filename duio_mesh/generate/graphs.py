"""Undirected connected graphs on the nodes 1 .. N."""

from __future__ import annotations

from collections.abc import Callable
from math import ceil, sqrt

import numpy as np

Edge = tuple[int, int]


def ring(N: int) -> list[Edge]:
    """A cycle; one edge for two nodes."""
    return path(N) + ([(1, N)] if N > 2 else [])


def path(N: int) -> list[Edge]:
    """A line."""
    return [(i, i + 1) for i in range(1, N)]


def grid(N: int) -> list[Edge]:
    """Rows of ceil(sqrt(N)) nodes, the last one perhaps shorter; edges to the right and downwards."""
    columns = ceil(sqrt(N))
    right = [(i, i + 1) for i in range(1, N) if i % columns]
    return sorted(right + [(i, i + columns) for i in range(1, N - columns + 1)])


def star(N: int) -> list[Edge]:
    """Node 1 is the hub."""
    return [(1, i) for i in range(2, N + 1)]


GRAPHS: dict[str, Callable[[int], list[Edge]]] = {"ring": ring, "path": path, "grid": grid, "star": star}
NAMES = (*GRAPHS, "random")


def edges(name: str, N: int, rng: np.random.Generator) -> list[Edge]:
    """The graph's edges (i, j), i < j, ascending. ``random`` is a tree of random links and N // 2 more edges."""
    if name != "random":
        return sorted(GRAPHS[name](N))
    found = {(int(rng.integers(1, i)), i) for i in range(2, N + 1)}
    free = [(i, j) for i in range(1, N) for j in range(i + 1, N + 1) if (i, j) not in found]
    more = rng.permutation(len(free))[: N // 2]
    return sorted(found | {free[k] for k in more})
