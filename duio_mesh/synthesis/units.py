"""The units of the states in which a design is computed: the file's own, and where that fails, even ones.

What is observable, or reached by an unknown input, is judged by singular values and by directions of length 1, which
mean little where pascals stand beside metres. The gains go back into the file's units afterwards, so a node, a message
and a row never know of this. All factors are powers of two: going there and back loses no bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.scenario.model import Normal, Scenario
from duio_mesh.synthesis.design import Design, Progress

APART = 64.0
"""Ratio of the largest to the smallest even unit below which the file's own are left: no example has more."""

NOTHING = -40.0
"""log2 of what an entry has to be beside the largest of its row or column; a smaller one is rounding."""


def in_some_units(scenario: Scenario, attempt: Callable[[Array], Design], progress: Progress) -> Design:
    """``attempt(s)`` with the file's units, s = 1, or where that fails with those of ``state_units``.

    Raises DesignError with the reason in the file's units, and where it is another one, in even units too.
    """
    try:
        return attempt(np.ones(scenario.plant.n))
    except DesignError as e:
        s = state_units(scenario)
        if (s == 1).all():
            raise
        own = str(e)
    progress("no design in the units of the file: trying even ones")
    try:
        return attempt(s)
    except DesignError as e:
        also = "" if str(e) == own else f" Beside that, with every state in a unit of its own: {e}"
        raise DesignError(f"{own}{also}") from None


def state_units(scenario: Scenario) -> Array:
    """s (n,) of x = diag(s) x', powers of two: in x' the entries of A, B, E and all C are of similar size.

    All 1 where that would change little. Which x' comes out does not depend on the units of the file.
    """
    plant, n = scenario.plant, scenario.plant.n
    inputs = np.hstack([plant.B, plant.E])
    outputs = np.vstack([node.C for node in scenario.nodes.values()])
    M = np.block([[plant.A, inputs], [outputs, np.zeros((len(outputs), inputs.shape[1]))]])
    with np.errstate(divide="ignore"):
        size = np.log2(np.abs(M))
    even = _even(size, np.isfinite(size), n)[1]
    least = NOTHING + np.minimum(even.max(axis=0), even.max(axis=1, keepdims=True))
    units = _even(size, np.isfinite(size) & (even >= least), n)[0]
    s: Array = np.exp2(np.round(units - units.mean()))
    return s if s.max() >= APART * s.min() else np.ones(n)


def _even(size: Array, counts: NDArray[np.bool_], n: int) -> tuple[Array, Array]:
    """log2 of the states' units (n,), and ``size`` (n + p, n + q), log2 of entries, in them.

    Least squares of the entries that count, with a free unit for every state, input and output, and for time: the
    scaling of Curtis and Reid (J. Inst. Maths Applics 10, 1972, 118) where state j's column gets what its row loses.
    The smallest solution where there are many.
    """
    (rows, columns), (i, j) = size.shape, np.nonzero(counts)
    of_row, time = np.r_[:n, columns : columns + rows - n], columns + rows - n
    dynamics = (np.arange(rows) < n).astype(np.float64)  # those rows are per unit of time
    e = sparse.eye_array(time + 1, format="csr")
    R = e[j] - e[of_row[i]] - dynamics[i, None] * e[np.full_like(i, time)]
    u: Array = np.linalg.lstsq((R.T @ R).toarray(), -(R.T @ size[i, j]), rcond=1e-10)[0]
    return u[:n], size + u[:columns] - (u[of_row] + u[time] * dynamics)[:, None]


def in_units(scenario: Scenario, s: Array) -> Scenario:
    """The scenario of x' = x / s, as far as a design looks at it: A, B, E, x0 and every C; not the feedback."""
    plant = scenario.plant
    x0 = Normal(plant.x0.mean / s, plant.x0.std / s) if isinstance(plant.x0, Normal) else plant.x0 / s
    A = plant.A / s[:, None] * s
    nodes = {i: replace(node, C=node.C * s) for i, node in scenario.nodes.items()}
    return replace(
        scenario, plant=replace(plant, A=A, B=plant.B / s[:, None], E=plant.E / s[:, None], x0=x0), nodes=nodes
    )


def from_state(M: Array, s: Array) -> Array:
    """What takes a state in the file's units where M (., n) takes it in the units s."""
    return M / s


def to_state(M: Array, s: Array) -> Array:
    """What gives a state in the file's units where M (n, .) gives it in the units s."""
    return s[:, None] * M


def even_columns(M: Array) -> Array:
    """Powers of two that bring the columns of M (m, n) nearest to length 1; 1 for a zero column."""
    lengths = np.linalg.norm(M, axis=0)
    s: Array = np.exp2(-np.round(np.log2(np.where(lengths > 0, lengths, 1.0))))
    return s


def said(s: Array) -> dict[str, list[float]]:
    """What a certificate says about it: nothing where the units are the file's own."""
    return {} if (s == 1).all() else {"state_units": s.tolist()}
