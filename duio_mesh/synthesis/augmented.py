"""Augmented-state distributed unknown-input observer (seed 001): existence, gains, certificate.

Discrete time, any graph: weighted, directed, in several parts. The theory is in ``augmented_existence``, the stacked
error recursion in ``augmented_error``, the designs in ``augmented_h2`` and ``augmented_channel``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import RTOL, Stability, detectability_decomposition, stable_radius
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.augmented_error import (
    ErrorSystem,
    Gains,
    Network,
    Sensor,
    Transient,
    distance_to_instability,
    error_blocks,
    transient,
)
from duio_mesh.synthesis.augmented_existence import View, check
from duio_mesh.synthesis.augmented_gains import find_gains, given_H
from duio_mesh.synthesis.augmented_options import BraschPearson, Options
from duio_mesh.synthesis.design import Design, Progress, above, below, node_spec, plant_spec
from duio_mesh.synthesis.noise import noise_covariance
from duio_mesh.synthesis.sampled import error_system
from duio_mesh.synthesis.uio import decouple_node
from duio_mesh.synthesis.units import from_state, in_some_units, in_units, said, to_state

__all__ = ["RADIUS_OF", "Options", "design", "error_radius"]

RADIUS_OF = "error matrix (12), per step"
LARGEST = 1000
"""Rows of the error matrix that the dense design still handles."""


class Figures(NamedTuple):
    """What the gains do, computed from Phi (12) alone."""

    radius: float
    powers: Transient
    distance: float
    rms: Array  # (N,), infinite unless Phi is Schur


def design(scenario: Scenario, progress: Progress) -> Design:
    """Check Lemma 4 and Theorem 8 (iv), find gains, verify them on the whole error system.

    Raises DesignError when the plant is not discrete, a condition fails (the message names nodes, eigenvalue and
    direction), given matrices have the wrong shape, or the gains miss the wanted decay rate, spectrum or peak.
    """
    if scenario.plant.time != "discrete":
        raise DesignError("augmented needs a discrete plant (time: discrete); its observers are difference equations")
    if scenario.options.written:
        return _design(scenario, np.ones(scenario.plant.n), progress)
    return in_some_units(scenario, lambda s: _design(scenario, s, progress), progress)


def _design(scenario: Scenario, s: Array, progress: Progress) -> Design:
    """The design in the units s (n,) of the states."""
    options: Options = scenario.options
    even = in_units(scenario, s)
    progress("existence conditions")
    network, views, margins = _network(even, options)
    stability = stable_radius(min(options.rate, 1 - 1e-9))
    rows = len(network.sensors) * network.n * (1 + options.delay)
    progress(f"existence conditions of {len(network.sensors)} nodes")
    sources = check(scenario.graph, views, network.A, stability)
    if rows > LARGEST:
        raise DesignError(
            f"augmented: gains exist (Theorem 8 holds), but the error matrix (12) has {rows} rows and is dense; from "
            f"{LARGEST} on a design takes hours. method: lmi (coupling gains by products with blocks) and "
            "method: admm handle thousands; or use fewer nodes"
        )
    found = find_gains(even, network, options, progress)
    gains = found.gains
    progress(f"certificate: eigenvalues, powers and distance to instability of {rows} rows")
    figures = _figures(network, gains, s)
    _refuse(figures, options)
    certificate = {
        "conditions": _conditions(margins, sources, figures.radius, options.rate),
        "nodes": _nodes(even, views, margins, stability, gains, figures.rms),
        "spectral_radius": figures.radius,
        "peak": _plain(figures.powers.peak),
        "steps_to_1e-3": figures.powers.steps,
        "distance_to_instability": figures.distance,
        "gains": found.method,
        "delay": options.delay,
        **said(s),
    }
    if found.note:
        certificate["gains_note"] = found.note
    specs = {
        i: _spec(even, i, network.A, sensor, own, s)
        for i, sensor, own in zip(scenario.nodes, network.sensors, gains, strict=True)
    }
    return Design(scenario, plant_spec(scenario), specs, certificate)


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of Phi (12) of graph.ids with the designed gains on another graph."""
    delay = design.scenario.options.delay
    blocks = [error_blocks(design.nodes[i].matrices, delay) for i in graph.ids]
    return spectral_radius(error_system(blocks, graph.laplacian()))


def _network(scenario: Scenario, options: Options) -> tuple[Network, dict[int, View], dict[int, float]]:
    """The decoupled sensors, what condition (iv) reads of them, and Lemma 4's scale-free margin of each node."""
    sensors, views, margins = [], {}, {}
    for i, node in scenario.nodes.items():
        own = decouple_node(scenario, i)
        H = given_H(options, i, node.C, own.basis)
        if H is None:
            H = -own.E
        sensors.append(Sensor(node.C, np.eye(scenario.plant.n) - H @ node.C, H, noise_covariance(node.noise)))
        views[i] = View(node.C, own.P, own.basis)  # condition (iv) is stated for H = D (C D)^+ whatever H is used
        margins[i] = own.margins["decoupling_rank"]
    return Network(scenario.plant.A, tuple(sensors), scenario.graph.laplacian(), options.delay), views, margins


def _figures(network: Network, gains: Sequence[Gains], s: Array) -> Figures:
    system = ErrorSystem(network, [len(g.S) for g in gains])
    Theta = system.theta(gains)
    Phi = system.matrix(Theta)
    return Figures(spectral_radius(Phi), transient(Phi), distance_to_instability(Phi), system.predicted_rms(Theta, s))


def _refuse(figures: Figures, options: Options) -> None:
    """Raise DesignError when the computed Phi is not what was asked for."""
    chosen = options.chosen()
    if figures.radius >= options.rate and not options.accept_unstable:
        raise DesignError(
            f"gains: {options.name}: the spectral radius of the whole error system is {figures.radius:.4g}, needed is "
            f"less than {options.rate:g}. accept_unstable: true runs such gains all the same."
        )
    if isinstance(chosen, BraschPearson):
        if figures.radius > chosen.radius + chosen.tolerance:
            raise DesignError(
                f"gains: brasch_pearson: the poles were asked for on the circle of radius {chosen.radius:g}, the "
                f"computed spectral radius is {figures.radius:.4g} (tolerance {chosen.tolerance:g}). Double precision "
                "cannot place the poles of so large an error system through one channel, or it has fixed modes. Use "
                "gains: h2."
            )
        if figures.powers.peak > chosen.peak:
            raise DesignError(
                f"gains: brasch_pearson: initial errors may grow by {figures.powers.peak:.3g} before they decay; "
                f"accepted is peak: {chosen.peak:g}. Use gains: h2, or raise tries or peak."
            )


def _conditions(
    margins: Mapping[int, float], sources: Sequence[Mapping[str, Any]], radius: float, rate: float
) -> dict[str, dict[str, Any]]:
    """What had to hold: margins are singular values relative to 1, so they are comparable between systems."""
    worst = min(margins, key=lambda i: margins[i])
    found = {f"Lemma 4 (node {worst})": above(margins[worst], RTOL)}
    for source in sources:
        name = f"Theorem 8 (iv), nodes {', '.join(map(str, source['nodes']))}"
        found[name] = above(min(source["kept"], 1.0), RTOL)
    found["Phi is Schur"] = below(radius, rate)
    return found


def _nodes(
    scenario: Scenario,
    views: Mapping[int, View],
    margins: Mapping[int, float],
    stability: Stability,
    gains: Sequence[Gains],
    rms: Array,
) -> dict[int, dict[str, Any]]:
    """Per node; predicted_rms is the stationary RMS error per state under the white noise of the file."""
    A, found = scenario.plant.A, {}
    for i, own, predicted in zip(scenario.nodes, gains, rms, strict=True):
        view = views[i]
        found[i] = {
            "decoupling_margin": margins[i],
            "undetectable_alone": detectability_decomposition(view.C, view.P @ A, stability).nu,
            "beta": len(own.S),
            "norm_F": float(np.linalg.norm(own.F, 2)),
            "norm_K": float(np.linalg.norm(own.K, 2)),
            "largest_gain": float(np.abs(own.theta).max()),
            "predicted_rms": _plain(float(predicted)),
        }
    return found


def _plain(value: float) -> float | None:
    """JSON has no infinity."""
    return value if np.isfinite(value) else None


def _spec(even: Scenario, i: int, A: Array, sensor: Sensor, gains: Gains, s: Array) -> NodeSpec:
    """(9): N = P A - F C, L = F + N H, M = P B_i, from the units s of the states to the file's."""
    C, P, H, _ = sensor
    F, K, Q, R, S = gains
    N = P @ A - F @ C
    to = {"N": N, "M": P @ even.known(i), "L": F + N @ H, "H": H, "K": K, "Q": Q}
    M = {name: to_state(matrix, s) for name, matrix in to.items()} | {"R": R, "S": S}
    matrices = M | {name: from_state(M[name], s) for name in ("N", "K", "R")}
    return node_spec(even, i, matrices, {"delay": even.options.delay})
