"""Graphs after something was lost."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import combinations
from typing import NamedTuple

from duio_mesh.scenario.model import Graph

Link = tuple[int, int]


class Loss(NamedTuple):
    """What is lost at once."""

    links: tuple[Link, ...] = ()  # an undirected edge with its smaller id first, an arc as (source, target)
    nodes: tuple[int, ...] = ()

    def words(self, graph: Graph) -> str:
        """For example ``edge 1-2``, ``arc 1->2`` or ``node 3``."""
        name, mark = ("arc", "->") if graph.directed else ("edge", "-")
        parts = [f"{name} {a}{mark}{b}" for a, b in self.links] + [f"node {i}" for i in self.nodes]
        return ", ".join(parts)


def links(graph: Graph) -> tuple[Link, ...]:
    """Edges (a < b) of an undirected graph, arcs of a directed one, in ascending order."""
    return tuple((a.source, a.target) for a in graph.arcs if graph.directed or a.source < a.target)


def losses(graph: Graph, number: int) -> Iterator[Loss]:
    """Every way to lose 1 to ``number`` edges and nodes at once: fewer first, edges before nodes."""
    single = [Loss((link,)) for link in links(graph)] + [Loss((), (i,)) for i in graph.ids]
    for k in range(1, number + 1):
        for chosen in combinations(single, k):
            gone = tuple(i for loss in chosen for i in loss.nodes)
            cut = tuple(link for loss in chosen for link in loss.links)
            if not any(end in gone for link in cut for end in link) and len(gone) < len(graph.ids):
                yield Loss(cut, gone)


def without(graph: Graph, loss: Loss) -> Graph:
    """The graph of those that are left, without the lost links (an undirected one in both directions)."""
    cut = set(loss.links) | (set() if graph.directed else {(b, a) for a, b in loss.links})
    arcs = tuple(a for a in graph.arcs if (a.source, a.target) not in cut)
    return restricted(Graph(graph.ids, arcs, graph.directed), set(graph.ids) - set(loss.nodes))


def restricted(graph: Graph, to: Collection[int]) -> Graph:
    """These nodes and the links between them."""
    arcs = tuple(a for a in graph.arcs if a.source in to and a.target in to)
    return Graph(tuple(i for i in graph.ids if i in to), arcs, graph.directed)
