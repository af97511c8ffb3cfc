"""How long a node's error is larger than it was, after a node was lost. Pure.

The error of node i at step k is the RMS over the components of x-hat_i(k) - x(k). For a loss in the steps a .. b-1:

- its *former level* is the RMS of that error over the last WINDOW steps before a (those of them that it estimated);
  it counts as at least ROUNDING times the RMS of the states there, because an error of rounding alone has no level;
- it is *back* at the first step k at which the error is at most TWICE that level, and the RMS of what it has
  estimated in the WINDOW steps from k on is so too (an error that only passes through zero is not back);
- the number of steps is k - b, counted from the return of the node that was lost, or k - a if it never returned.

None: there was no level, or it was not back WINDOW steps before the end of the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.report.pairing import Span, runs
from duio_mesh.trace import Trace

WINDOW = 20  # steps
TWICE = 2.0
ROUNDING = 1e-12


def recovery(trace: Trace) -> list[dict[str, Any]]:
    """Every loss, in the order of the steps, as plain data.

    ``node``: who was lost; ``lost``: [a, b], steps a .. b-1; ``returned``: whether it came back; ``steps``: by every
    node's id, as a string, the steps until its error was back; None as above.
    """
    ids, K = trace.node_ids.tolist(), len(trace.t)
    losses = sorted((span, at) for at, row in enumerate(trace.lost) for span in runs(np.flatnonzero(row)))
    if not losses:
        return []
    errors, states = _mean_squares(trace.xhat - trace.x), _mean_squares(trace.x)
    after = [_windows(e) for e in errors]
    found = []
    for (a, b), lost in losses:
        start = b if b < K else a
        steps = {str(i): _steps(errors[at], after[at], states, (a, start)) for at, i in enumerate(ids)}
        found.append({"node": ids[lost], "lost": [a, b], "returned": b < K, "steps": steps})
    return found


def loss_in_words(loss: Mapping[str, Any]) -> str:
    """One entry of ``recovery`` as a sentence."""
    a, b = loss["lost"]
    when = f"was away in steps {a} to {b - 1}" if loss["returned"] else f"is gone from step {a} on"
    steps = {i: "never" if k is None else "at once" if k == 0 else f"after {k}" for i, k in loss["steps"].items()}
    if not loss["returned"]:
        del steps[str(loss["node"])]
    each = ", ".join(f"node {i} {words}" for i, words in steps.items())
    since = "the return" if loss["returned"] else "the loss"
    return f"node {loss['node']} {when}; steps from {since} until errors are under twice what they were: {each}"


def _mean_squares(vectors: Array) -> Array:
    """Mean over the last axis of the squares; an overflow is infinite."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(np.mean(np.square(vectors), axis=-1))


def _steps(squares: Array, after: Array, states: Array, at: Span) -> int | None:
    """The steps after ``at[1]``, with the level before ``at[0]``; all arguments are squares."""
    a, start = at
    before = slice(max(0, a - WINDOW), a)
    there = ~np.isnan(squares[before])
    if not there.any() or not np.isfinite(squares[before][there]).all():
        return None
    level = max(float(np.mean(squares[before][there])), ROUNDING**2 * float(np.mean(states[before][there])))
    limit = TWICE**2 * level
    back: NDArray[np.int64] = np.flatnonzero((squares[start : len(after)] <= limit) & (after[start:] <= limit))
    return int(back[0]) if len(back) else None


def _windows(squares: Array) -> Array:
    """(K - WINDOW + 1,) means over those of the WINDOW values from each on that there are; 0 where there is none."""
    if len(squares) < WINDOW:
        return np.zeros(0)
    there = ~np.isnan(squares)
    sums, counts = (
        sliding_window_view(values, WINDOW).sum(axis=1) for values in (np.where(there, squares, 0.0), there)
    )
    return np.asarray(sums / np.maximum(counts, 1))
