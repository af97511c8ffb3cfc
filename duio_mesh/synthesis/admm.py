"""Distributed unknown-input observer by distributed optimisation (seed 002): conditions, gains, certificate.

Discrete time, undirected graphs, also in several parts: every island must reconstruct the state on its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import stable_radius
from duio_mesh.scenario.model import Scenario
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.admm_contingency import RADIUS_OF, error_left, error_radius
from duio_mesh.synthesis.admm_local import LEAST_CURVATURE, Local, check_joint, facts, local_estimates, noise_gain
from duio_mesh.synthesis.admm_options import Options
from duio_mesh.synthesis.admm_rates import (
    Island,
    fused_maps,
    fusion_radius,
    island_facts,
    iterates,
    spectrum,
    worst_error,
)
from duio_mesh.synthesis.design import Design, Progress, node_spec, plant_spec
from duio_mesh.synthesis.units import even_columns, from_state, in_some_units, in_units, said, to_state

__all__ = ["RADIUS_OF", "Options", "design", "error_left", "error_radius"]

_ROUNDING = 1e-6  # finite_time must be exact to this, or the graph has too many different eigenvalues


def design(scenario: Scenario, progress: Progress) -> Design:
    """Local estimates, H and the fusion's constants for every node.

    Raises DesignError when the plant is not discrete, the graph not undirected, a node has no stable local estimate, an
    island cannot reconstruct the state (Assumption 2, with the missing directions), or the fusion does not converge.
    """
    options: Options = scenario.options
    if scenario.plant.time != "discrete":
        raise DesignError("admm needs a discrete plant (time: discrete); its local estimates are difference equations")
    if options.watch_step is not None and options.watch_step >= scenario.run.steps:
        raise DesignError(
            f"observer.watch_step: there is no step {options.watch_step} in a run of {scenario.run.steps} steps"
        )
    if not options.needs_H:  # without H^-1 in front of the gradient the fusion itself depends on the units
        return _design(scenario, np.ones(scenario.plant.n), progress)
    return in_some_units(scenario, lambda units: _design(scenario, units, progress), progress)


def _design(scenario: Scenario, units: Array, progress: Progress) -> Design:
    """The design in these units (n,) of the states; the fusion in those in which H has a diagonal of ones."""
    options: Options = scenario.options
    progress("what each node can follow alone")
    nodes, stability = local_estimates(in_units(scenario, units), options), stable_radius(options.stable_radius)
    found = said(units)
    if found:
        s = even_columns(np.vstack([local.T for local in nodes.values()]))
        nodes, units = {i: local._replace(T=local.T * s) for i, local in nodes.items()}, units * s
    islands: dict[int, Island] = {}
    described = []
    for ids in scenario.graph.islands():
        progress(f"fusion of nodes {list(ids)}")
        eigenvalues = check_joint(ids, nodes, stability)
        island = island_of(scenario, ids, nodes)

        def say(what: str, at: tuple[int, ...] = ids) -> None:
            progress(f"fusion of {len(at)} nodes from {at[0]}: {what}")

        radius = _converges(island, options, say)
        gains = units * noise_gain((nodes[i] for i in ids), fused_maps(island, options))
        described.append(island_facts(island, options, eigenvalues, radius, gains, say))
        islands |= dict.fromkeys(ids, island)
    specs = {i: _spec(scenario, i, local, islands[i], units) for i, local in nodes.items()}
    certificate = _certificate(options, nodes, islands, described) | found
    return Design(scenario, plant_spec(scenario), specs, certificate)


def island_of(scenario: Scenario, ids: tuple[int, ...], nodes: Mapping[int, Local]) -> Island:
    """The fusion problem of one connected component. Raises DesignError when an edge works one way only."""
    graph = scenario.graph
    at = [graph.ids.index(i) for i in ids]
    L = graph.laplacian()[np.ix_(at, at)]
    if not np.array_equal(L, L.T):
        raise DesignError(
            f"admm needs an undirected graph (edges:), but among nodes {list(ids)} some arcs go one way only"
        )
    T = tuple(nodes[i].T for i in ids)
    H = sum((Ti.T @ Ti for Ti in T), np.zeros_like(scenario.plant.A))
    return Island(ids, T, L, H, np.asarray(np.linalg.inv(H)))


def _converges(island: Island, options: Options, say: Progress) -> float:
    """The fusion's spectral radius."""
    if options.fusion == "finite_time":
        *_, last = iterates(island, options)
        if worst_error(last) > _ROUNDING:
            raise DesignError(
                f"finite_time loses too many digits on nodes {list(island.ids)}: {len(spectrum(island.L))} rounds end "
                f"{worst_error(last):.1e} beside the exact mean; use fusion: admm or relaxed on this graph"
            )
    radius = fusion_radius(island, options, say)
    if radius >= 1:
        raise DesignError(
            f"the fusion of nodes {list(island.ids)} does not converge: spectral radius {radius:.6f}; "
            + ("observer.alpha_factor is too large" if options.alpha_factor > 1 else "H is too ill-conditioned")
        )
    return radius


def _spec(scenario: Scenario, i: int, local: Local, island: Island, units: Array) -> NodeSpec:
    """Its own matrices, H^-1 if the launcher is to provide it, and scalars.

    ``units``: of the states in T and H. What the node fuses is in the file's: with H^-1 in front of the gradient every
    fusion is the same iteration in all units.
    """
    options: Options = scenario.options
    P, L = local.filter.P, local.filter.L
    matrices = {"Abar": local.filter.Abar, "PL": P @ L, "PB": local.PB, "T": from_state(local.T, units), "s0": local.s0}
    given: dict[str, Any] = {"fusion": options.fusion, "setup": options.setup}
    if options.watch_step is not None:
        given["watch_step"] = options.watch_step
    if options.setup == "distributed":
        matrices["units"] = units
    elif options.needs_H:
        matrices["Hinv"] = to_state(island.inverse, units) * units
    if options.fusion == "admm":
        given |= {"gamma": options.gamma, "nu": options.nu, "alpha_factor": options.alpha_factor}
    elif options.fusion == "relaxed":
        given |= {"c": options.c, "rounds": options.rounds}
    if options.fusion == "finite_time" or options.setup == "distributed":
        given |= {"island_size": len(island.ids), "eigenvalues": spectrum(island.L)}
    predicts = options.without == "predict" or (options.without == "auto" and options.fusion == "finite_time")
    if scenario.patchy and predicts:
        matrices |= {"A": scenario.plant.A, "B": scenario.known(i)}
    return node_spec(scenario, i, matrices, given)


def _certificate(
    options: Options, nodes: Mapping[int, Local], islands: Mapping[int, Island], described: list[dict[str, Any]]
) -> dict[str, Any]:
    """``spectral_radius`` is that of the error from step to step, which lives in the local estimates alone.

    The fusion starts afresh in every step and remembers nothing: after exact fusion the error of every node is
    H^-1 sum T_i'[e_i; v_i] with e_i(k+1) = Abar_i e_i(k) - P_i L_i v_i(k). A truncated fusion adds at most
    ``predicted_fusion_error`` times |x(k)|.
    """
    curvature = min(1 / island["H_condition"] for island in described)
    fusion = max(island["fusion_radius"] for island in described)
    found: dict[str, Any] = {
        "conditions": {
            "assumption_2": {"value": curvature, "threshold": f"> {LEAST_CURVATURE:g}", "ok": True},
            "fusion_radius": {"value": fusion, "threshold": "< 1", "ok": True},
        },
        "nodes": {i: facts(local) for i, local in nodes.items()},
        "spectral_radius": max(local.radius for local in nodes.values()),
        "islands": described,
        "fusion": options.fusion,
    }
    if options.fusion == "admm":
        for i, island in islands.items():
            at = island.ids.index(i)
            found["nodes"][i]["alpha"] = float(island.step_sizes(options)[at])
    return found
