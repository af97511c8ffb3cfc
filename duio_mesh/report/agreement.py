"""The verdict of a run without a truth: how far the nodes agree with each other and with each other's measurements.

Nobody knows the true state of a real plant, so there is no error to be below a limit. What can be said of node i over a
set of steps, both as the RMS per component:

- disagreement: x-hat_i(k) minus the mean of all nodes' estimates of x(k), in the unit of the states,
- residual: y_i(k) - C_i x-hat_j(k) over all other nodes j, in the unit of the measurements: what node i measures, and
  what the others, who do not see it, expect it to measure. It holds the sensor's own noise. (With x-hat_i itself it
  would be zero by construction for most methods: they fit their own measurements. A node alone has only that.)

Small figures do not prove that the estimates are right: all nodes may be wrong together where nobody measures. Large
ones prove that something is wrong: the model, a sensor, or an input that is driven and that nobody counts with.

In a run that goes on without a lost node, only the estimates that there are count, in both figures and in the mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.scenario.model import Scenario
from duio_mesh.trace import Trace

AGREE, DISAGREE, INCOMPLETE = "the nodes agree", "the nodes do not agree", "incomplete"


def agreement(trace: Trace, scenario: Scenario, steps: slice) -> dict[int, dict[str, float]]:
    """Node -> {"disagreement", "residual"} over these steps; NaN where a row is missing or there is none."""
    figures = {}
    there = ~trace.lost[:, steps]
    xhat = np.where(there[:, :, None], trace.xhat[:, steps], 0.0)
    with np.errstate(over="ignore", invalid="ignore"):
        middle = xhat.sum(axis=0) / np.maximum(there.sum(axis=0), 1)[:, None]
        for at, i in enumerate(trace.node_ids.tolist()):
            C, own, others = scenario.nodes[i].C, there[at], there.copy()
            others[at] = not np.delete(there, at, axis=0).any()  # alone, it has only itself
            missed = trace.samples[i][steps, : C.shape[0]] - xhat @ C.T
            figures[i] = {
                "disagreement": _rms((xhat[at] - middle)[own]),
                "residual": _rms(missed[others & own]),
            }
    return figures


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def verdict(figures: Mapping[int, Mapping[str, float]], limit: float, *, complete: bool) -> dict[str, Any]:
    """The keys of metrics.json that differ without a truth: ``converged`` is null, for nobody can know."""
    good = complete and all(value < limit for node in figures.values() for value in node.values())
    return {
        "verdict": AGREE if good else DISAGREE if complete else INCOMPLETE,
        "converged": None,
        "agree": good,
    }
