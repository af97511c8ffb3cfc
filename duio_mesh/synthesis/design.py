"""What every synthesis returns, and the parts that all methods share: the plant's spec and the node specs' frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array, contiguous
from duio_mesh.errors import DesignError
from duio_mesh.scenario.model import Lqr, Normal, OpenLoop, Plant, Run, Scenario
from duio_mesh.spec import NodeSpec, PlantSpec, SensorSpec
from duio_mesh.synthesis.propagation import propagators

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Design:
    """Per node what it may know, for the plant what it needs, and what the design promises."""

    scenario: Scenario
    plant: PlantSpec
    nodes: Mapping[int, NodeSpec]
    certificate: Mapping[str, Any]  # plain data: conditions, nodes, spectral_radius | spectral_abscissa, ...


def node_spec(
    scenario: Scenario, i: int, matrices: Mapping[str, Array], options: Mapping[str, Any] | None = None
) -> NodeSpec:
    """The spec of node i with these matrices (made C-contiguous), before it has an endpoint."""
    node, run = scenario.nodes[i], scenario.run
    flow = flow_control(run, run.window)
    return NodeSpec(
        id=i,
        method=scenario.method,
        n=scenario.plant.n,
        p=node.C.shape[0],
        m=scenario.known(i).shape[1],
        matrices={name: contiguous(M) for name, M in matrices.items()},
        options=dict(options or {}),
        hears=scenario.graph.hears(i),
        tells=scenario.graph.tells(i),
        steps=run.steps,
        deadline=run.deadline,
        window=flow.window,
        credit=flow.quarter,
        block=1 if scenario.outside else flow.quarter,  # what comes from outside is passed on at once
        batch=run.batch,
        outside=scenario.outside is not None,
        faults=scenario.faults.into(i, () if run.on_node_loss == "stop" else scenario.graph.hears(i)),
        spoils=scenario.faults.spoilt_by(i),
        without=scenario.options.without if scenario.patchy else "",
        on_loss=run.on_node_loss,
        warm=run.rejoin == "warm",
        acts=scenario.faults.of(i),
        breaks=tuple(scenario.faults.returns()),
    )


class Flow(NamedTuple):
    """How far the plant may be ahead."""

    window: int  # steps: at least two batches, or a node could not fill one while it fuses another
    quarter: int  # steps between two words from node to plant, and in one frame from plant to node: keeps both busy


def flow_control(run: Run, window: int) -> Flow:
    """The flow control for a window of so many steps; whole batches, between which a node can come back."""
    window = max(window, 2 * run.batch)
    return Flow(window, max(1, window // 4 // run.batch) * run.batch)


def below(value: float, threshold: float) -> dict[str, Any]:
    """A condition of a certificate: value < threshold."""
    return {"value": value, "relation": "<", "threshold": threshold, "ok": bool(value < threshold)}


def above(value: float, threshold: float) -> dict[str, Any]:
    """A condition of a certificate: value > threshold."""
    return {"value": value, "relation": ">", "threshold": threshold, "ok": bool(value > threshold)}


def plant_spec(scenario: Scenario) -> PlantSpec:
    """The plant process' spec; LQR gain and continuous propagators are computed here.

    Raises DesignError when no LQR gain exists, or when signals switch too often to be propagated exactly.
    """
    plant, run = scenario.plant, scenario.run
    flow = flow_control(run, run.window)
    sensors = []
    for i, node in scenario.nodes.items():
        known = tuple(j for j, name in enumerate(plant.inputs) if name in set(node.knows))
        sensors.append(SensorSpec(i, contiguous(node.C), known, contiguous(node.noise.channel), node.noise.signals))
    control = plant.control
    feedback: dict[str, Array] = {}
    if not isinstance(control, OpenLoop):
        F = lqr_gain(plant, control) if isinstance(control, Lqr) else control.F
        feedback = {"F": contiguous(F), "reference": contiguous(control.reference)}
    propagated = _propagated(plant, feedback, run.steps) if plant.time == "continuous" else {}
    x0 = plant.x0
    if isinstance(x0, Normal):
        initial = {"mean": contiguous(x0.mean), "std": contiguous(x0.std)}
    else:
        initial = {"value": contiguous(x0)}
    return PlantSpec(
        time=plant.time,
        step=plant.step,
        matrices={"A": contiguous(plant.A), "B": contiguous(plant.B), "E": contiguous(plant.E)} | propagated,
        x0=initial,
        feedback=feedback,
        control=control.signals if isinstance(control, OpenLoop) else (),
        disturbance=plant.disturbance,
        sensors=tuple(sensors),
        seed=run.seed,
        steps=run.steps,
        window=flow.window,
        block=1 if scenario.outside else flow.quarter,
        deadline=run.deadline,
        on_loss=run.on_node_loss,
        absent={i: spans for i in scenario.nodes if (spans := scenario.faults.absences(i))},
        outside=scenario.outside,
    )


def _propagated(plant: Plant, feedback: Mapping[str, Array], steps: int) -> dict[str, Array]:
    """The exact propagators of a continuous plant; feedback acts continuously, inside the propagated dynamics."""
    A, control = plant.A, plant.control
    drives = control.signals if isinstance(control, OpenLoop) else ((),) * plant.B.shape[1]
    if feedback:
        A = A + plant.B @ feedback["F"]
    return propagators(A, np.hstack([plant.B, plant.E]), (*drives, *plant.disturbance), plant.step, steps)


def lqr_gain(plant: Plant, weights: Lqr) -> Array:
    """F (m, n) of u = F (x - reference), minimising sum x'Qx + u'Ru (seed 000, (54)); for the plant's own time."""
    A, B, Q, R = plant.A, plant.B, weights.Q, weights.R
    solve = linalg.solve_discrete_are if plant.time == "discrete" else linalg.solve_continuous_are
    try:
        P = solve(A, B, Q, R)
    except (linalg.LinAlgError, ValueError) as e:
        raise DesignError(
            f"plant.control.lqr: no LQR gain exists for these A, B, Q, R ({e}). Is (A, B) stabilisable and R positive "
            "definite? Give the feedback itself with control: {F: ...} otherwise."
        ) from None
    left = R + B.T @ P @ B if plant.time == "discrete" else R
    right = B.T @ P @ A if plant.time == "discrete" else B.T @ P
    return np.asarray(-linalg.solve(left, right, assume_a="pos"))
