"""What is left of a design when edges or nodes are lost for good and every node keeps its gains (docs/contingency.md).

A method takes part by one function in its synthesis file, ``error_radius(design, graph) -> float``: the spectral radius
of the errors of graph.ids under the designed gains, with the graph's Laplacian in place of the designed one; below 1
they go to zero. ``RADIUS_OF`` beside it says of what it is the radius. The graph is one island. A method that starts
afresh in every step has ``error_left(design, graph)`` too: how much of the error is left at the end of a step.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from typing import Any

import numpy as np

from duio_mesh.errors import DesignError
from duio_mesh.scenario.model import Graph
from duio_mesh.synthesis.design import Design, Progress
from duio_mesh.synthesis.losses import Loss, losses, restricted, without

CONTRACTS = 1 - 1e-9
"""A radius from here on is rounding's word against one."""


def with_contingency(design: Design, number: int, progress: Progress = lambda _: None) -> Design:
    """The design with ``contingency`` in its certificate. Raises DesignError as ``contingency`` does."""
    found = contingency(design, number, progress)
    return replace(design, certificate={**design.certificate, "contingency": found})


def contingency(design: Design, number: int = 1, progress: Progress = lambda _: None) -> dict[str, Any]:
    """Every loss of up to ``number`` edges and nodes, as plain data.

    ``nominal``, ``nominal_failing``: as a case, without a loss. ``cases``: per loss ``lost`` in words, ``links`` and
    ``nodes``, ``radius`` (None when the estimates go to something wrong), ``reconstructs``, and ``failing``: the
    islands whose errors do not contract. ``worst``: what is lost in the case with the largest radius. ``survives``:
    all cases reconstruct. ``left``, of methods that start afresh in every step: what a step leaves of the error.
    Raises DesignError when the method has no error matrix to offer or ``number`` is less than 1.
    """
    method = importlib.import_module(f"duio_mesh.synthesis.{design.scenario.method}")
    if not hasattr(method, "error_radius"):
        raise DesignError(f"contingency: {design.scenario.method} says nothing about its errors on another graph")
    if number < 1:
        raise DesignError(f"contingency: should be at least 1 edge or node, not {number}")
    graph, known = design.scenario.graph, dict[Graph, float]()

    def radius(island: Graph) -> float:
        """An island that a loss does not touch is as it was."""
        if island not in known:
            known[island] = float(method.error_radius(design, island))
        return known[island]

    leaves = getattr(method, "error_left", None)

    def left_over(island: Graph) -> float:
        return float(leaves(design, island)) if leaves else 0.0

    def case(loss: Loss) -> dict[str, Any]:
        left = without(graph, loss)
        radii = {island: radius(restricted(left, island)) for island in left.islands()}
        failing = [list(island) for island, value in radii.items() if not value < CONTRACTS]
        return {
            "lost": loss.words(graph),
            "links": [list(link) for link in loss.links],
            "nodes": list(loss.nodes),
            "radius": _plain(max(radii.values())),
            "reconstructs": not failing,
            "failing": failing,
        } | ({"left": _plain(max(left_over(restricted(left, ids)) for ids in radii))} if leaves else {})

    progress("contingency: nothing lost")
    nominal = case(Loss())
    cases = []
    for loss in losses(graph, number):
        progress(f"contingency: {loss.words(graph)}")
        cases.append(case(loss))
    worst = max(cases, key=lambda c: np.inf if c["radius"] is None else c["radius"], default=None)
    return {
        "radius_of": method.RADIUS_OF,
        "nominal": nominal["radius"],
        "nominal_failing": nominal["failing"],
        "cases": cases,
        "worst": worst["lost"] if worst else None,
        "survives": all(c["reconstructs"] for c in cases),
    }


def _plain(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None
