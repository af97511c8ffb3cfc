"""Minimising the largest eigenvalue of large matrices that depend on few numbers: the program behind (38).

    minimise t   subject to   S_p(g, t) >= 0   for every pencil p                                 (see pencil.py)

A semidefinite program with m + 1 unknowns and matrices of N = sum nu_i rows. Few of those rows decide: on a subspace
X (N, k) the program has k rows and a smaller optimum, which is a lower bound; its g has a largest eigenvalue, which is
an upper one, and the eigenvectors of that widen X (after Kangal, Meerbergen, Mengi, Michiels, "A subspace method for
large-scale eigenvalue optimization", 2018). The bounds meet when k is some 50 to 150, whatever N is. Only products
with the pencils are needed, until at the end a block Cholesky factor proves the upper bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.synthesis import barrier
from duio_mesh.synthesis.pencil import Pencil

GAP, LOOSE = 1e-10, 1e-6
"""How far the value should and may be from the least one, relative to max(1, the value at g = 0)."""
PATIENCE = 3
"""Rounds without a smaller gap after which rounding is to blame for it."""
PROVEN = 1e-9
"""How far above the value its proof is: rounding in Cholesky factors, relative to the same."""
WIDEN = 10
"""Eigenvectors that widen a subspace in a round."""
ROUNDS = 100

Say = Callable[[str], None]


class Optimum(NamedTuple):
    """The g with the least value, and the interval that holds that least value."""

    g: Array  # (m,), 0 where it has no effect in any pencil
    value: float  # the least t at g: 1 + beta_u
    lower: float  # no g does better than this


class _Best(NamedTuple):
    g: Array
    value: float


def minimise_largest_eigenvalue(pencils: Sequence[Pencil], say: Say = lambda _: None) -> Optimum:
    """The g that minimises the largest value of all pencils, which have the same nodes and the same criterion.

    ``say`` hears how near the optimum is in every round. Raises DesignError when the wanted accuracy is not reached.
    """
    m = pencils[0].m
    pencils = [pencil for pencil in pencils if pencil.N]
    if not pencils:
        return Optimum(np.zeros(m), 0.0, 0.0)
    free = np.any([pencil.active for pencil in pencils], axis=0)
    spaces = [np.zeros((pencil.N, 0)) for pencil in pencils]
    g, best, lower, scale = np.zeros(m), _Best(np.zeros(m), np.inf), 0.0, 1.0
    gap, stuck = np.inf, 0
    for k in range(ROUNDS):
        value = _widen(pencils, spaces, g, lower)
        if k == 0:
            scale = max(1.0, value)
            if not free.any():
                lower = value
        if value < best.value:
            best = _Best(g, value)
        size = max(space.shape[1] for space in spaces)
        at = f"beta_u in [{lower - 1:+.9f}, {best.value - 1:+.9f}], {size} directions of {pencils[0].N}"
        say(at)
        gap, stuck = best.value - lower, stuck + 1 if best.value - lower >= gap else 0
        if gap <= GAP * scale or (stuck == PATIENCE and gap <= LOOSE * scale):
            break
        chosen = [p for p, space in enumerate(spaces) if space.shape[1]]
        problems = [pencils[p].reduced(spaces[p]).only(free) for p in chosen]
        wanted = max(0.05 * min(gap, scale), 0.05 * GAP * scale)
        centre = barrier.minimise(problems, best.g[free], best.value, wanted, _after(at, say))
        g = np.zeros(m)
        g[free] = centre.g
        lower = max(lower, centre.lower)
    say("proof of the bound by block Cholesky factors")
    proven = all(pencil.holds(best.g, best.value + PROVEN * scale) for pencil in pencils)
    if not (proven and gap <= LOOSE * scale):
        raise DesignError(
            f"the eigenvalue problem behind (38) was not solved: the best value found is {best.value:.9g}"
            f"{'' if proven else ', which its Cholesky factor does not confirm'}, and {lower:.9g} is known to be a "
            "lower bound. Are the matrices scaled very unevenly?"
        )
    return Optimum(best.g, best.value, lower)


def _after(what: str, say: Say) -> Say:
    return lambda now: say(f"{what}, {now}")


def _widen(pencils: Sequence[Pencil], spaces: list[Array], g: Array, lower: float) -> float:
    """The largest value at g; every pencil that exceeds the lower bound gets its eigenvectors into its subspace."""
    values = []
    for p, (pencil, X) in enumerate(zip(pencils, spaces, strict=True)):
        start = X.sum(axis=1) if X.shape[1] else np.ones(pencil.N)
        value, vectors = pencil.leading(g, min(WIDEN, pencil.N), start)
        values.append(value)
        if value > lower:
            for _ in range(2):  # twice is enough
                basis, triangle = np.linalg.qr(vectors - X @ (X.T @ vectors))
                vectors = basis[:, np.abs(np.diag(triangle)) > 1e-9]
            spaces[p] = np.hstack([X, vectors])
    return max(values)
