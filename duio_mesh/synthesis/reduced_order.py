"""Reduced-order distributed unknown-input observer with unknown-input and noise reconstruction (seed 004).

Continuous time, directed strongly connected graphs. Every node knows the same inputs; the others, and the plant's
disturbances, are the unknown input f that every node reconstructs beside the state and its own measurement noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.geometry.staircase import detectability_decomposition
from duio_mesh.geometry.subspace import GeometryError, norm
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.design import Design, Progress, node_spec, plant_spec
from duio_mesh.synthesis.reduced_order_local import WORST_CONDITION, Model, Separated, hidden_from, separate
from duio_mesh.synthesis.reduced_order_network import Node, choose
from duio_mesh.synthesis.reduced_order_options import Options, bounds_of
from duio_mesh.synthesis.sampled import Coupled, Step, error_system, largest_step, modes
from duio_mesh.synthesis.units import from_state, in_some_units, in_units, said, to_state

__all__ = ["RADIUS_OF", "Options", "design", "error_radius"]

RADIUS_OF = "sampled error system, per tick"


def design(scenario: Scenario, progress: Progress) -> Design:
    """Gains, conditions and node specs.

    Raises DesignError, with numbers and node names, when the plant is not continuous, nodes know different inputs,
    Assumption 1 or 2 fails, observer.rate asks for unreliable gains, the graph does not connect the nodes that need
    help, the coupling cannot reach a direction that no node sees (sufficient condition), or the coupling is unstable at
    this step.
    """
    return in_some_units(scenario, lambda units: _design(scenario, units, progress), progress)


def _design(scenario: Scenario, units: Array, progress: Progress) -> Design:
    """The design in these units (n,) of the states."""
    even = in_units(scenario, units)
    D, unknown = _unknown_input(even)
    bounds_of(scenario.options, D.shape[1])
    plant, separated = even.plant, {}
    for i, node in even.nodes.items():
        progress(f"node {i}: removing noise and unknown input")
        model = Model(plant.A, even.known(i), D, node.C, node.noise.channel)
        separated[i] = separate(model, f"node {i}", unknown)
    _jointly_detectable(even, D, separated, unknown)
    chosen = choose(even, separated, progress)
    network, steps, c = chosen
    certificate = {
        "conditions": _conditions(network.nodes, network.spread),
        "nodes": {i: _facts(node) for i, node in network.nodes.items()},
        "spectral_abscissa": network.growth(c),
        "sampled_radius": network.radius(c, steps),
        "c": c,
        "sigma": network.sigma,
        "rate": network.rate,
        "c_bound_13": network.bound,
        **said(units),
        "step": plant.step,
        "largest_step": largest_step(chosen.radius, plant.step),
    }
    specs = {i: _spec(scenario, i, node, steps[i], c, units) for i, node in network.nodes.items()}
    return Design(scenario, plant_spec(scenario), specs, certificate)


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of the sampled errors of graph.ids with the designed gains on another graph."""
    n, blocks = design.scenario.plant.n, []
    for i in graph.ids:
        M = design.nodes[i].matrices
        blocks.append(Coupled(M["Phi"], M["K"], np.eye(n), M["Os"][:n]))
    return spectral_radius(error_system(blocks, graph.laplacian()))


def _unknown_input(scenario: Scenario) -> tuple[Array, list[str]]:
    """D (n, q) and its columns' names: what no node knows."""
    plant = scenario.plant
    if plant.time != "continuous":
        raise DesignError("reduced_order needs a continuous plant (time: continuous, and step: under run)")
    known = {i: frozenset(node.knows) for i, node in scenario.nodes.items()}
    first = next(iter(known))
    for i, names in known.items():
        if names != known[first]:
            raise DesignError(
                f"reduced_order reconstructs one unknown input at every node, so all nodes must know the same inputs; "
                f"node {first} knows {sorted(known[first])}, node {i} knows {sorted(names)}"
            )
    D = scenario.unknown(first)
    unknown = [name for name in plant.inputs if name not in known[first]]
    unknown += [f"disturbance {k + 1}" for k in range(plant.E.shape[1])]
    lengths = np.linalg.norm(D, axis=0)
    seen = np.linalg.svd(D / np.where(lengths > 0, lengths, 1.0), compute_uv=False)  # whatever the inputs' units
    if D.shape[1] and (D.shape[1] > plant.n or seen[-1] <= 1e-9 * seen[0]):
        raise DesignError(
            f"the unknown inputs ({', '.join(unknown)}) do not enter independently: singular values of D "
            f"(columns of length 1) are {np.array2string(seen, precision=3)}; combine dependent columns"
        )
    return D, unknown


def _jointly_detectable(scenario: Scenario, D: Array, separated: Mapping[int, Separated], unknown: list[str]) -> None:
    """Assumption 1: all nodes' noise-free measurements together leave no unstable invariant zero.

    A rank condition, so no gain is computed. Raises DesignError with the modes that are left.
    """
    plant = scenario.plant
    C = np.vstack([np.vstack([s.W1, s.W2]) @ scenario.nodes[i].C for i, s in separated.items()])
    s = separate(Model(plant.A, plant.B, D, C, np.zeros((C.shape[0], 0))), "all nodes together", unknown)
    try:
        left = detectability_decomposition(s.C22, s.A22, hidden_from(0.0)).eigenvalues
    except GeometryError as e:
        raise DesignError(f"all nodes together: {e}") from None
    if left.size:
        raise DesignError(
            f"Assumption 1 fails: with the unknown inputs acting, all measurements together do not show the modes at "
            f"{modes(left)} (Re >= 0), where rank [sI - A, D; C~, 0] < n + q"
        )


def _conditions(nodes: Mapping[int, Node], spread: float | None) -> dict[str, dict[str, Any]]:
    weakest = min(node.separated.margin for node in nodes.values())
    found: dict[str, dict[str, Any]] = {
        "assumption_1": {"value": 0, "threshold": "0 modes with Re >= 0 hidden from all nodes together", "ok": True},
        "assumption_2": {"value": weakest, "threshold": f"> {1 / WORST_CONDITION:g}", "ok": True},
    }
    if spread is not None:
        found["network"] = {"value": spread, "threshold": "> 0: least eigenvalue of Y'(L^ kron I)Y", "ok": True}
    return found


def _facts(node: Node) -> dict[str, Any]:
    s, gains = node.separated, node.gains
    return {
        "unknown_input_margin": s.margin,
        "left_to_network": int(gains.Tu.shape[1]),
        "left_to_network_modes": modes(gains.undetectable),
        "own_abscissa": float(gains.own.real.max()) if gains.own.size else None,
        "gain_norm": norm(gains.N),
        "state_error_in_unknown_input": node.bounds.amplification,
    }


def _spec(scenario: Scenario, i: int, node: Node, step: Step, c: float, units: Array) -> NodeSpec:
    """Everything that a tick needs, combined: state s = [z2-hat; eta+], output [x-hat; alpha; v-hat] = Os s + Oy y.

    ``units``: of the states that the node was designed in; x-hat and the neighbours' are in the file's.
    """
    options: Options = scenario.options
    s, bounds, sensor = node.separated, node.bounds, scenario.nodes[i]
    q, k = s.W1.shape[0], s.A22.shape[0]
    width = bounds.width / options.kappa  # delta of (16), which starts at its equilibrium and stays there
    U1, V2 = to_state(s.U1, units), to_state(s.V2, units)
    to_x = np.hstack([V2, np.zeros((V2.shape[0], q))]), U1 @ np.linalg.solve(s.C11, s.W1)
    to_alpha = np.hstack([np.zeros((q, k)), np.diag(1 / width)]), -s.W1 / width[:, None]
    Fplus = np.linalg.pinv(sensor.noise.channel)
    to_v = -Fplus @ sensor.C @ to_x[0], Fplus - Fplus @ sensor.C @ to_x[1]
    inverse = np.linalg.inv(bounds.G)
    l0, l1 = 1.5 * np.sqrt(options.lipschitz), 1.1 * options.lipschitz
    matrices = {
        "Phi": step.Phi,
        "Gamma": step.Gamma,
        "K": c * step.K @ from_state((s.V2 @ node.gains.Tu).T, units),
        "bias": step.bias,
        "Os": np.vstack([to_x[0], to_alpha[0], to_v[0]]),
        "Oy": np.vstack([to_x[1], to_alpha[1], to_v[1]]),
        "f0": inverse @ bounds.p_plus,
        "f_alpha": inverse * bounds.width,
        "f_rate": inverse * width,
        "W1": s.W1,
        "middle": width / 2,
    }
    return node_spec(scenario, i, matrices, {"q": q, "h": scenario.plant.step, "l0": float(l0), "l1": l1})
