"""metrics.json: how good the estimates are, and whether that is good enough.

An error is measured per component: the RMS of node i over a set of steps is

    sqrt( mean over the steps k and over the n components of (x-hat_i(k) - x(k))^2 ),

in the unit of the states. (So it does not grow with n, and can be compared with the noise of one sensor. It is the
2-norm's RMS divided by sqrt(n); the levels of seed 000's examples are given in this convention.)
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.report.agreement import agreement, verdict
from duio_mesh.report.recovery import recovery
from duio_mesh.report.remarks import presence, present, remarks
from duio_mesh.scenario.model import Convergence, Scenario
from duio_mesh.trace import Trace


def metrics(trace: Trace, scenario: Scenario, counts: Mapping[str, Any]) -> dict[str, Any]:
    """What metrics.json holds, plain data that JSON can say.

    ``counts`` is what the run itself counted (rounds, rounds_per_second, messages, faults, ...), passed on as it is.
    A node's ``rms`` is over the steps of the verdict, its ``final`` at the last step, both per component; null where it
    has no finite estimate (a lost process, a diverged observer). A run that ended early is ``incomplete`` and has not
    converged, however small its errors were. Without a truth ``converged`` and the errors are null, and the verdict is
    about how far the nodes agree (``report/agreement.py``); such a run may be over before its last step.

    Where messages can be missing, a node also has what ``presence`` says; of one that was away, ``rms`` is over the
    steps that there are, ``final`` of its last estimate, and the verdict over the nodes that are there at the end.
    ``remarks`` are what has to be said beside the verdict, ``recovery`` how long the errors were larger after each loss
    (``report/recovery.py``; not without a truth).
    """
    wanted = scenario.run.convergence
    window = judged(trace, wanted)
    rms, final = rms_errors(trace, window), final_errors(trace)
    ids = trace.node_ids.tolist()
    whole = _whole(trace) and not (trace.lost.any() and counts.get("failure"))
    complete = len(trace.t) >= scenario.run.steps and whole
    good = complete and converged(trace, wanted)
    said: dict[str, Any] = {
        "verdict": "converged" if good else "not converged" if complete else "incomplete",
        "converged": good,
    }
    own = presence(trace)
    nodes = {
        str(i): {"rms": _finite(rms[at]), "final": _finite(final[at])} | own.get(i, {}) for at, i in enumerate(ids)
    }
    if scenario.outside:
        complete = len(trace.t) > 0 and not counts.get("failure") and _whole(trace)
        figures = agreement(trace, scenario, window)
        there = dict(zip(ids, present(trace).tolist(), strict=True))
        judging = {i: found for i, found in figures.items() if there[i]}
        said = verdict(judging, wanted.rms_below, complete=complete)
        for i, found in figures.items():
            nodes[str(i)] |= {name: _finite(value) for name, value in found.items()}
    if trace.flagged is not None and not counts.get("failure"):  # else the nodes' rows end where the end caught them
        said |= {"remarks": remarks(trace)}
        if not scenario.outside:  # nobody knows an error
            said |= {"recovery": recovery(trace)}
    return {
        **said,
        "criterion": {"rms_below": wanted.rms_below, "from_step": window.start},
        "nodes": nodes,
        "steps": len(trace.t),
        "seed": scenario.run.seed,
        **counts,
        "estimates_sha256": hashlib.sha256(trace.xhat.astype("<f8", order="C", copy=False).tobytes()).hexdigest(),
    }


def converged(trace: Trace, convergence: Convergence) -> bool:
    """Whether the RMS error of every node that is there at the end is below the limit over the last part of the run.

    A NaN or no step never is, and neither are no nodes.
    """
    there = present(trace)
    if not len(trace.t) or not there.any():
        return False
    return bool(np.all(rms_errors(trace, judged(trace, convergence))[there] < convergence.rms_below))


def judged(trace: Trace, convergence: Convergence) -> slice:
    """The steps that the verdict looks at: the last ``over_last`` of the run, at least one."""
    K = len(trace.t)
    return slice(max(0, K - max(1, round(K * convergence.over_last))), K)


def rms_errors(trace: Trace, steps: slice) -> Array:
    """(N,) RMS error per component of every node over these steps, without those of which it has no estimate.

    NaN where any estimate is NaN or there is none. Scaled by the largest error, so that an observer that diverged gives
    a large number and no overflow.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # inf - inf of a run that left the floats is NaN, and says so
        there = ~trace.lost[:, steps]
        error = np.where(there[:, :, None], trace.xhat[:, steps] - trace.x[steps], 0.0)
        largest = np.max(np.abs(error), axis=(1, 2), initial=0.0)
        scale = np.where(largest > 0, largest, 1.0)
        scaled = error / scale[:, None, None]
        numbers = there.sum(axis=1) * error.shape[2]
        mean = np.sum(scaled**2, axis=(1, 2)) / np.maximum(numbers, 1)
        return np.where(numbers > 0, scale * np.sqrt(mean), np.nan)


def final_errors(trace: Trace) -> Array:
    """(N,) as ``rms_errors``, of every node's last estimate alone."""
    last = [np.flatnonzero(~lost)[-1:] for lost in trace.lost]
    return np.array([rms_errors(trace, slice(k[0], k[0] + 1))[at] if len(k) else np.nan for at, k in enumerate(last)])


def _whole(trace: Trace) -> bool:
    """Whether somebody is there at the end and no row is missing but of nodes that the run goes on without."""
    return bool(present(trace).any()) and not (np.isnan(trace.xhat).any(axis=2) & ~trace.lost).any()


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
