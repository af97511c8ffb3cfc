"""Geometric unknown-input observers, centralised (one node) and distributed (seed 003), continuous time.

Every node may lack different inputs, and need not satisfy rank(C_i B_i) = rank(B_i). The paper's bound (21) on chi is
reported but not trusted: on four of the six-state example's graphs the error diverges above it
(``docs/observers/geometric.md``). What decides here are the eigenvalues of the whole error system.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field, NegativeFloat, NonNegativeFloat, PositiveFloat
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.geometry.subspace import intersection, norm
from duio_mesh.scenario.model import Graph, OpenLoop, Scenario, Signal
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.design import Design, Progress, node_spec, plant_spec
from duio_mesh.synthesis.geometric_local import LocalUio, local_uio
from duio_mesh.synthesis.sampled import (
    Coupled,
    HoldOptions,
    Step,
    abscissa,
    choose_gain,
    error_system,
    largest_step,
    modes,
    sampled,
)
from duio_mesh.synthesis.uio import check_quotient
from duio_mesh.synthesis.units import from_state, in_some_units, in_units, said, to_state

RADIUS_OF = "sampled error system, per tick; the larger of two: sign term saturated, and around zero"


_CURE = "more edges, another sensor, a further known input or kappa > 0 (own damping inside W_g of nodes of group N2)"


class Options(HoldOptions):
    """The keys under ``observer:`` for ``method: geometric``."""

    chi: PositiveFloat | Literal["auto"] = "auto"
    """Linear coupling gain, 1/s. ``auto``: the smallest one whose sampled error decays about as fast as any."""
    gamma: NonNegativeFloat = 1.0
    """Gain of the sign term, in units of the state per second: has to outweigh what unknown inputs do inside W_g."""
    sign: Literal["saturation", "sign"] = "saturation"
    """``saturation``: linear below degree x gamma x step, which is what an implicit Euler step of the sign gives;
    ``sign``: as printed, chatters with an amplitude of about gamma x step."""
    kappa: NonNegativeFloat = 0.0
    """1/s. Own damping of N2 nodes inside W_g; makes large chi stable on graphs where the paper's L does not."""
    poles: tuple[NegativeFloat, ...] | None = Field(default=None, min_length=1)
    """Wanted eigenvalues on X/W_g, 1/s; each node takes as many as it can place, in order. Default: Riccati gains."""


def design(scenario: Scenario, progress: Progress) -> Design:
    """Local observers, coupling gain, conditions and node specs.

    Raises DesignError, with numbers and node names, when the plant is not continuous, the graph is directed, Lemma 2
    fails for a node on its own, Assumption 3 fails on an island of the graph, or the error system is unstable, in
    continuous time or at this step.
    """
    if scenario.plant.time != "continuous":
        raise DesignError("geometric needs a continuous plant (time: continuous, and step: under run)")
    if scenario.graph.directed:
        raise DesignError("geometric needs an undirected graph (edges, not arcs): seed 003, Assumption 1")
    return in_some_units(scenario, lambda s: _design(scenario, s, progress), progress)


def _design(scenario: Scenario, s: Array, progress: Progress) -> Design:
    """The design in the units s (n,) of the states."""
    options: Options = scenario.options
    plant, graph = scenario.plant, scenario.graph
    even, nodes = in_units(scenario, s), {}
    for i, node in even.nodes.items():
        progress(f"node {i}: subspaces and local gains")
        args = node.C, even.plant.A, even.known(i), even.unknown(i)
        nodes[i] = local_uio(*args, options.poles, options.kappa, f"node {i}")
        check_quotient(nodes[i].structure, even, i)
    conditions = _conditions(scenario, nodes)
    progress("choosing the coupling")
    L, h = graph.laplacian(), plant.step
    steps = {i: sampled(node.local, h, options) for i, node in nodes.items()}

    def growth(chi: float) -> float:
        return abscissa(error_system([node.coupled(chi) for node in nodes.values()], L))

    def rho(chi: float, at: float = h) -> float:
        """The larger spectral radius of two: with the sign term saturated, and in its linear zone around zero."""
        exact = steps if at == h else {i: sampled(node.local, at, options) for i, node in nodes.items()}
        near = {i: _slope(scenario, options, i, at) for i in nodes}
        return max(
            spectral_radius(error_system([node.coupled(chi, slope[i], exact[i]) for i, node in nodes.items()], L))
            for slope in (near, dict.fromkeys(nodes, 0.0))
        )

    chi = choose_gain("chi", options.chi, growth, rho, h, L, _CURE)
    bounds = bounds_21(even, nodes)
    needed = bounds["gamma_needed"]
    if needed is not None:
        enough = options.gamma >= needed
        conditions["gamma"] = {"value": options.gamma, "threshold": f">= {needed:.4g}, or errors stay", "ok": enough}
    certificate = {
        "conditions": conditions,
        "nodes": {i: _facts(node) for i, node in nodes.items()},
        "spectral_abscissa": growth(chi),
        "sampled_radius": rho(chi),
        "chi": chi,
        "gamma": options.gamma,
        **bounds,
        **said(s),
        "step": h,
        "largest_step": largest_step(lambda at: rho(chi, at), h),
    }
    specs = {i: _spec(scenario, i, node, steps[i], chi, s) for i, node in nodes.items()}
    return Design(scenario, plant_spec(scenario), specs, certificate)


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of the sampled errors of graph.ids with the designed gains on another graph."""
    radii = []
    for near in (True, False):
        blocks = []
        for i in graph.ids:
            M, given = design.nodes[i].matrices, design.nodes[i].options
            slope = given["gamma"] / given["width"] if near and given["width"] else 0.0
            blocks.append(Coupled(M["Phi"], M["K"], (given["chi"] + slope) * M["R"], M["X"]))
        radii.append(spectral_radius(error_system(blocks, graph.laplacian())))
    return max(radii)


def _width(scenario: Scenario, options: Options, i: int, h: float) -> float:
    """Of the saturation that stands for the sign at node i: degree x gamma x step; 0 for the sign itself."""
    return sum(scenario.graph.hears(i).values()) * options.gamma * h if options.sign == "saturation" else 0.0


def _slope(scenario: Scenario, options: Options, i: int, h: float) -> float:
    """What the saturation adds to chi around zero."""
    width = _width(scenario, options, i, h)
    return options.gamma / width if width else 0.0


def _conditions(scenario: Scenario, nodes: Mapping[int, LocalUio]) -> dict[str, dict[str, Any]]:
    """Lemma 2 for nodes on their own, Assumption 3 on every island with more."""
    left = {}
    for island in scenario.graph.islands():
        if len(island) == 1:
            (i,) = island
            if nodes[i].hidden:
                raise DesignError(
                    f"node {i} has no neighbours and cannot follow the state alone: W_g* and Ker C have "
                    f"{nodes[i].hidden} common direction(s) (Lemma 2 asks for 0). Its W* has dimension "
                    f"{nodes[i].structure.W.shape[1]}, its bad zeros are {modes(nodes[i].structure.bad)}"
                )
            continue
        common = np.eye(scenario.plant.n)
        for i in island:
            s = nodes[i].structure
            common = intersection(common, s.V if nodes[i].group == "N1" else s.Wg)
        if common.shape[1]:
            sizes = {i: nodes[i].R.shape[0] for i in island}
            raise DesignError(
                f"Assumption 3 fails for nodes {list(island)}: {common.shape[1]} direction(s) of the state are hidden "
                f"from all of them, first {np.round(common[:, 0], 4).tolist()}. Dimensions of V_i (N1) and "
                f"W_g,i (N2): {sizes}. Connect islands, add a sensor or tell an input"
            )
        left[island] = 0
    found: dict[str, dict[str, Any]] = {}
    if left:
        found["assumption_3"] = {"value": 0, "threshold": "0 directions hidden from all nodes of an island", "ok": True}
    alone = [i for i, node in nodes.items() if not node.hidden]
    if alone:
        found["lemma_2"] = {"value": alone, "threshold": "nodes that need no neighbours", "ok": True}
    return found


def bounds_21(scenario: Scenario, nodes: Mapping[int, LocalUio]) -> dict[str, float | None]:
    """The paper's bounds (21) on chi and gamma, and what gamma has to outweigh; None where they do not exist.

    ``chi`` grows without limit when its matrix is singular. ``gamma`` depends on the bases of W_g; the unknown inputs'
    bounds are read off their signals and unknown for feedback and ``normal``.
    """
    WV = linalg.block_diag(*(node.R.T for node in nodes.values()))
    AL = linalg.block_diag(*(node.inner for node in nodes.values()))
    n = scenario.plant.n
    least = np.linalg.svd(WV.T @ np.kron(scenario.graph.laplacian(), np.eye(n)) @ WV, compute_uv=False)
    chi = float(norm(AL) / least[-1]) if least.size and least[-1] > 1e-9 * least[0] else None
    second = {i: node for i, node in nodes.items() if node.group == "N2"}
    sizes = {i: _unknown_sizes(scenario, i) for i in second}
    known = {i: u for i, u in sizes.items() if u is not None}
    if len(known) < len(second) or not second:
        return {"chi_bound_21": chi, "gamma_bound_21": None, "gamma_needed": None}
    Bbar = {i: scenario.unknown(i) for i in second}
    paper = (
        max(u.max(initial=0.0) for u in known.values())
        * max(np.abs(B).sum(axis=0).max(initial=0.0) for B in Bbar.values())
        * max(np.abs(node.structure.Wg).sum(axis=1).max() for node in second.values())
    )
    needed = max((np.abs(second[i].R @ Bbar[i]) @ u).max(initial=0.0) for i, u in known.items())
    return {"chi_bound_21": chi, "gamma_bound_21": float(paper), "gamma_needed": float(needed)}


def _unknown_sizes(scenario: Scenario, i: int) -> Array | None:
    """Bounds on |u| of the inputs that node i is not told, None when they cannot be read off the signals."""
    plant, known = scenario.plant, set(scenario.nodes[i].knows)
    hidden = [j for j, name in enumerate(plant.inputs) if name not in known]
    signals = list(plant.disturbance)
    if hidden:
        if not isinstance(plant.control, OpenLoop):
            return None
        signals = [plant.control.signals[j] for j in hidden] + signals
    sizes = [_largest(signal) for signal in signals]
    return None if any(size is None for size in sizes) else np.array(sizes, dtype=np.float64)


def _largest(signal: Signal) -> float | None:
    total = 0.0
    for term in signal:
        for kind, p in term.items():
            if kind == "normal":
                return None
            values = {"constant": ("value",), "step": ("before", "after")}.get(kind, ("amplitude",))
            total += max(abs(p[name]) for name in values)
    return total


def _facts(node: LocalUio) -> dict[str, Any]:
    s = node.structure
    return {
        "group": node.group,
        "dim_W": s.W.shape[1],
        "dim_S": s.S.shape[1],
        "dim_V": s.V.shape[1],
        "dim_Wg": s.Wg.shape[1],
        "zeros": modes(s.zeros),
        "own_abscissa": float(node.own.real.max()) if node.own.size else None,
        "gain_norm": norm(node.L),
    }


def _spec(scenario: Scenario, i: int, node: LocalUio, step: Step, chi: float, s: Array) -> NodeSpec:
    """What a tick needs: z = Phi z + Gamma history + K push, x-hat = X z + F y, and the coupling's gains.

    ``s``: the units of the states that the node was designed in; x-hat and the neighbours' are in the file's.
    """
    options: Options = scenario.options
    gamma = options.gamma if node.group == "N2" else 0.0
    width = _width(scenario, options, i, scenario.plant.step) if gamma else 0.0
    X, F, R = to_state(node.X, s), to_state(node.F, s), from_state(node.R, s)
    matrices = {"Phi": step.Phi, "Gamma": step.Gamma, "K": step.K, "X": X, "F": F, "R": R}
    return node_spec(scenario, i, matrices, {"chi": chi, "gamma": gamma, "width": width})
