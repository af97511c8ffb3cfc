"""What is left of a design when edges or nodes are lost for good and every node keeps its gains (docs/contingency.md).

A method takes part by one function in its synthesis file, ``error_radius(design, graph) -> float``: the spectral radius
of the errors of graph.ids under the designed gains, with the graph's Laplacian in place of the designed one; below 1
they go to zero. ``RADIUS_OF`` beside it says of what it is the radius. The graph is one island. A method that starts
afresh in every step has ``error_left(design, graph)`` too: how much of the error is left at the end of a step.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np

from duio_mesh.errors import DesignError
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

    ``nominal``, ``nominal_failing``: as a case, without a loss. ``cases``: per loss, see ``Cases``. ``worst``: what is
    lost in the case with the largest radius. ``survives``: all cases reconstruct.
    Raises DesignError when the method has no error matrix to offer or ``number`` is less than 1.
    """
    if number < 1:
        raise DesignError(f"--contingency: should be at least 1 edge or node, not {number}")
    case = Cases(design, progress)
    nominal = case(Loss())
    cases = [case(loss) for loss in losses(design.scenario.graph, number)]
    worst = max(cases, key=lambda c: np.inf if c["radius"] is None else c["radius"], default=None)
    return {
        "radius_of": case.radius_of,
        "nominal": nominal["radius"],
        "nominal_failing": nominal["failing"],
        "cases": cases,
        "worst": worst["lost"] if worst else None,
        "survives": all(c["reconstructs"] for c in cases),
    }


class Cases:
    """What is left of one design after a loss, as plain data; islands that a loss does not touch are computed once.

    ``lost`` in words, ``links`` and ``nodes``, ``radius`` (None when the estimates go to something wrong),
    ``reconstructs``, and ``failing``: the islands whose errors do not contract. ``left``, of methods that start afresh
    in every step: what a step leaves of the error.
    """

    def __init__(self, design: Design, progress: Progress = lambda _: None) -> None:
        """Raises DesignError when the method has no error matrix to offer."""
        method = _method(design)
        self._graph, self._progress = design.scenario.graph, progress
        self.radius_of = radius_of(design)
        self._radius = cache(lambda island: float(method.error_radius(design, island)))
        self._left = cache(lambda island: float(method.error_left(design, island)))
        self._afresh = hasattr(method, "error_left")

    def __call__(self, loss: Loss) -> dict[str, Any]:
        """The case of one loss."""
        self._progress(f"--contingency: {loss.words(self._graph) or 'nothing lost'}")
        left = without(self._graph, loss)
        islands = {ids: restricted(left, ids) for ids in left.islands()}
        radii = {ids: self._radius(island) for ids, island in islands.items()}
        failing = [list(ids) for ids, value in radii.items() if not value < CONTRACTS]
        return {
            "lost": loss.words(self._graph),
            "links": [list(link) for link in loss.links],
            "nodes": list(loss.nodes),
            "radius": _plain(max(radii.values())),
            "reconstructs": not failing,
            "failing": failing,
        } | ({"left": _plain(max(map(self._left, islands.values())))} if self._afresh else {})


def radius_of(design: Design) -> str:
    """Of what the radii of this design's cases are. Raises DesignError as ``Cases`` does."""
    return str(_method(design).RADIUS_OF)


def _method(design: Design) -> ModuleType:
    method = importlib.import_module(f"duio_mesh.synthesis.{design.scenario.method}")
    if not hasattr(method, "error_radius"):
        raise DesignError(f"--contingency: {design.scenario.method} says nothing about its errors on another graph")
    return method


def _plain(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None
