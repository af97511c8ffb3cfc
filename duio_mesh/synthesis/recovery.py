"""What the loss of each single node means for the others, said before the run (``run.on_node_loss``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from duio_mesh.errors import DesignError
from duio_mesh.observers import make_observer
from duio_mesh.synthesis.contingency import Cases
from duio_mesh.synthesis.design import Design, Progress, flow_control
from duio_mesh.synthesis.losses import Loss

SETTLED = 1e-3  # of an error: what is left of it when a process that began from nothing is trusted
GROWTH = 10.0  # of errors while a node is away, in a window
CONTRACTS_NOT = 1e-6  # above 1: a radius that rounding alone does not explain
LEFT = 1e-3  # of an error: what a step that starts afresh may leave after a loss, or twice what it leaves anyway


def with_recovery(design: Design, progress: Progress = lambda _: None) -> Design:
    """The design for a run that goes on without a lost node.

    The certificate gets ``node_loss``: per node the case of its loss (``contingency.Cases``). Every node's spec gets
    ``excuses``: the neighbours without which its own island still reconstructs, so that their silence is no reason
    to doubt its estimate. Where a node comes back, that it can: DesignError when the method found H in step 0.
    """
    scenario = design.scenario
    if scenario.run.on_node_loss == "restart" and getattr(scenario.options, "setup", "global") == "distributed":
        raise DesignError(
            "run.on_node_loss: restart: a node that comes back has missed the set-up in which the nodes find H "
            "themselves; let the launcher find it (observer.setup: global)"
        )
    settling = _settling(design)
    case = Cases(design, progress)
    enough = max(LEFT, 2 * (case(Loss()).get("left") or 0.0))
    found = {i: case(Loss((), (i,))) for i in design.nodes if len(design.nodes) > 1}
    nodes = {
        i: replace(spec, settling=settling, excuses=tuple(j for j in spec.hears if _allows(found[j], i, enough)))
        for i, spec in design.nodes.items()
    }
    certificate = {**design.certificate, "node_loss": found}
    design = replace(design, nodes=nodes, certificate=certificate)
    return _in_reach(design, found) if scenario.run.on_node_loss == "restart" else design


def _in_reach(design: Design, losses: Mapping[int, dict[str, Any]]) -> Design:
    """The design with a smaller window, since the others are up to a window ahead when a lost node comes back.

    In rounds rather than steps; and where errors grow without a node, at most GROWTH times in so many steps.
    """
    run, spec = design.scenario.run, next(iter(design.nodes.values()))
    window = run.window // make_observer(spec).rounds
    worst = max((case["radius"] or 0.0 for case in losses.values()), default=0.0)
    if worst > 1 + CONTRACTS_NOT:
        window = min(window, int(np.log(GROWTH) / np.log(worst)))
    flow = flow_control(run, window)
    block = 1 if design.scenario.outside else flow.quarter
    return replace(
        design,
        plant=replace(design.plant, window=flow.window, block=block),
        nodes={
            i: replace(node, window=flow.window, credit=flow.quarter, block=block) for i, node in design.nodes.items()
        },
    )


def _settling(design: Design) -> int:
    """Steps in which the certificate's radius (abscissa) brings errors down to SETTLED of what they were."""
    found, steps = design.certificate, design.plant.steps
    radius = float(found.get("spectral_radius") or np.exp(found.get("spectral_abscissa", 0.0) * design.plant.step))
    return min(steps, int(np.ceil(np.log(SETTLED) / np.log(radius)))) if 0 < radius < 1 else steps


def _allows(case: dict[str, Any], i: int, enough: float) -> bool:
    left = case.get("left", 0.0)
    return left is not None and left <= enough and all(i not in island for island in case["failing"])
