"""The nodes and the graph of a topology, checked against the plant and against each other."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from duio_mesh.scenario import model, schema
from duio_mesh.scenario.plant import PLANT, PlantParts
from duio_mesh.scenario.problems import Path, Problems, did_you_mean, listed
from duio_mesh.scenario.shapes import Size, has_length, matrix
from duio_mesh.scenario.signals import normalised, white
from duio_mesh.scenario.validate import describe, fields, whole

NODES: Path = ("nodes",)
MAX_ID = 2**31 - 1


def read_nodes(written: Any, plant: PlantParts, problems: Problems) -> dict[int, model.Node | None] | None:
    """Nodes by ascending id, None for those with a problem; None when it cannot be told which nodes there are."""
    if not isinstance(written, Mapping):
        problems.at(NODES, f"should be a mapping from node ids to nodes, not {describe(written)}")
        return None
    if not written:
        problems.at(NODES, "there should be at least one node")
    if len(written) > schema.MAX_NODES:
        problems.at(NODES, f"there should be at most {schema.MAX_NODES} nodes, not {len(written)}")
        return None
    nodes: dict[int, model.Node | None] = {}
    for i, node in written.items():
        if isinstance(i, int) and 1 <= i <= MAX_ID:
            nodes[i] = _node(i, node, plant, problems)
        else:
            problems.at_key((*NODES, i), f"a node's id should be a positive whole number, not {describe(i)}")
    return dict(sorted(nodes.items()))


def _node(i: int, written: Any, plant: PlantParts, problems: Problems) -> model.Node | None:
    path = (*NODES, i)
    given = fields(schema.Node, written, path, problems)
    width = Size(plant.states.number, "one per state") if plant.states else None
    C = matrix(given.get("C"), (*path, "C"), problems, width=width)
    for k, name in enumerate(given.get("knows", ())):
        if plant.inputs is not None and name not in plant.inputs:
            near = did_you_mean(name, plant.inputs)
            rest = near or (
                f"; the inputs are {listed(plant.inputs, 'and')}" if plant.inputs else "; the plant has none"
            )
            problems.at((*path, "knows", k), f"no such input: {name}{rest}")
        elif name in given["knows"][:k]:
            problems.at((*path, "knows", k), f"{name} is named twice")
    own = given.get("noise")
    count = len(given["C"]) if "C" in given else None
    if own is not None or "noise" not in given:
        noise = _noise(own, (*path, "noise"), count, problems)
    else:
        noise = _noise(plant.noise, (*PLANT, "noise"), count, problems, of=f" of node {i}")
    if C is None or noise is None or "knows" not in given:
        return None
    return model.Node(i, C, tuple(given["knows"]), noise)


def _noise(
    written: schema.Noise | float | None, path: Path, count: int | None, problems: Problems, of: str = ""
) -> model.Noise | None:
    """Noise of a node with ``count`` measurements; none when nothing is written, or a standard deviation of 0."""
    if isinstance(written, float | int) and written:
        problems.at(path, f"say what {written:g} is: {{variance: {written:g}}} or {{std: {written:g}}}")
        return None
    if count is None:
        return None
    if isinstance(written, schema.Noise) and written.channel is not None and written.signals is not None:
        rows = Size(count, f"one per measurement{of}")
        channel = matrix(written.channel, (*path, "channel"), problems, height=rows)
        if channel is None:
            return None
        columns = Size(channel.shape[1], "one signal per column of the channel")
        fits = has_length(written.signals, (*path, "signals"), problems, columns)
        return model.Noise(channel, tuple(normalised(s) for s in written.signals)) if fits else None
    std = 0.0
    if isinstance(written, schema.Noise):
        std = math.sqrt(written.variance) if written.variance is not None else written.std or 0.0
    return model.Noise(np.eye(count), (white(std),) * count) if std else model.Noise(np.zeros((count, 0)), ())


def read_graph(written: Any, ids: Collection[int] | None, problems: Problems) -> model.Graph | None:
    """The graph over these node ids; when the ids are not known only the graph's form is checked."""
    path: Path = ("graph",)
    graph = whole(schema.Graph, written, path, problems)
    if graph is None:
        return None
    directed = graph.arcs is not None
    name = "arcs" if directed else "edges"
    arcs: dict[tuple[int, int], float] = {}
    for k, link in enumerate(written[name]):
        ends = _ends(link, (*path, name, k), ids, problems)
        if ends is None:
            continue
        if ends in arcs:
            problems.at((*path, name, k), f"{list(ends)} is {'an arc' if directed else 'an edge'} already")
            continue
        weight = float(link[2]) if len(link) == 3 else 1.0
        if weight <= 0:
            problems.at((*path, name, k, 2), f"a weight should be greater than 0, not {link[2]!r}")
        arcs[ends] = weight
        if not directed:
            arcs[ends[::-1]] = weight
    ordered = tuple(model.Arc(*ends, weight) for ends, weight in sorted(arcs.items()))
    return model.Graph(tuple(sorted(ids or ())), ordered, directed)


def _ends(link: list[Any], path: Path, ids: Collection[int] | None, problems: Problems) -> tuple[int, int] | None:
    """The two ends of a link, None after a report when it cannot be one."""
    fine = True
    for k, end in enumerate(link[:2]):
        if type(end) is not int:
            problems.at((*path, k), f"should be the id of a node, not {describe(end)}")
            fine = False
        elif ids is not None and end not in ids:
            problems.at((*path, k), f"no such node: {end}; the nodes are {listed(sorted(ids), 'and')}")
            fine = False
    if fine and link[0] == link[1]:
        problems.at(path, f"node {link[0]} cannot be its own neighbour")
        fine = False
    return (link[0], link[1]) if fine else None
