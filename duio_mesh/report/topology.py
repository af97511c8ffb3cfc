"""Where the nodes of a graph are drawn: deterministic, neighbours about 1 apart, islands side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from duio_mesh.arrays import Array

MANY = 100  # nodes of one island from which on stress minimisation takes too long
GAP = 1.5  # between islands


def positions(ids: Sequence[int], arcs: Sequence[tuple[int, int]]) -> dict[int, tuple[float, float]]:
    """(x, y) of every node, y down. A ring is a circle with its smallest id on top; other islands minimise stress."""
    import networkx as nx

    graph = nx.Graph()
    graph.add_nodes_from(sorted(ids))
    graph.add_edges_from(sorted((min(a), max(a)) for a in arcs))
    islands = [_island(nx, graph.subgraph(part)) for part in sorted(nx.connected_components(graph), key=min)]
    return _side_by_side(islands)


def _island(nx: Any, graph: Any) -> dict[int, Array]:
    """Positions of one connected island; its closest two nodes are 1 apart and its corner is (0, 0)."""
    ids = sorted(graph)
    if len(ids) == 1:
        return {ids[0]: np.zeros(2)}
    if len(ids) > 2 and all(degree == 2 for _, degree in graph.degree):
        order = [ids[0], *(j for _, j in list(nx.dfs_edges(graph, ids[0])))]
        angles = 2 * np.pi * np.arange(len(order)) / len(order)
        at = {i: np.array([np.sin(a), -np.cos(a)]) for i, a in zip(order, angles, strict=True)}
    else:
        start = nx.circular_layout(ids)
        layout = nx.kamada_kawai_layout(graph, pos=start) if len(ids) <= MANY else nx.spring_layout(graph, seed=0)
        at = {i: np.asarray(layout[i], dtype=np.float64) for i in ids}
    points = np.array([at[i] for i in at])
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    closest = max(float(apart[~np.eye(len(points), dtype=bool)].min()), 1e-3)
    corner = points.min(axis=0)
    return {i: (p - corner) / closest for i, p in at.items()}


def _side_by_side(islands: list[dict[int, Array]]) -> dict[int, tuple[float, float]]:
    """The islands on shelves that together are about as wide as high."""
    sizes = [np.max(list(island.values()), axis=0) + GAP for island in islands]
    width = max(float(np.sqrt(sum(w * h for w, h in sizes) * 1.5)), *(float(w) for w, _ in sizes))
    placed: dict[int, tuple[float, float]] = {}
    x = y = shelf = 0.0
    for island, (w, h) in zip(islands, sizes, strict=True):
        if x and x + w > width:
            x, y, shelf = 0.0, y + shelf, 0.0
        placed |= {i: (float(x + p[0]), float(y + p[1])) for i, p in island.items()}
        x, shelf = x + w, max(shelf, h)
    return placed
