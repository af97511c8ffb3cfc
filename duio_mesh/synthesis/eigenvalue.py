"""Minimising the largest eigenvalue of matrices that depend on few numbers: the semidefinite program behind (38).

    minimise gamma   subject to   S_k(x, gamma) = gamma I - F_k(x) >= 0 for every pencil k

has one more unknown than there are x_i, while a general solver carries a scaling for every pair of entries of S. So
this is a log-barrier method on (x, gamma): exact Newton steps, whose gradient and Hessian the pencils give. The result
is certified afterwards: the value is an eigenvalue computed at x, and a dual point bounds the least value from below.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.pencil import Factored, Pencil

GAP = 1e-8
"""How far the value may be from the least one, relative to max(1, the value at x = 0)."""
LARGE, LOOSE = 1000, 2e-3
"""From so many rows on rounding may hide the flat directions; then the gap may be so wide. It is reported."""
FACTOR = 30.0
"""The weight of the value against the barrier grows by this."""

RANKS = (1e-14, 1e-12, 1e-10, 1e-8)
"""Relative sizes below which a direction of the Hessian counts as flat."""

Say = Callable[[str], None]


class Optimum(NamedTuple):
    """The x with the least value, and the interval that holds that least value."""

    x: Array  # (m,), 0 where it has no effect in any pencil
    value: float  # the largest of the pencils' values at x
    lower: float  # no x does better than this


class _Point(NamedTuple):
    """x of the free unknowns and gamma, with all S_k factored."""

    unknowns: Array  # (free + 1,)
    factored: tuple[Factored, ...]

    @property
    def log_det(self) -> float:
        return sum(f.log_det for f in self.factored)


class _Problem(NamedTuple):
    pencils: tuple[Pencil, ...]
    free: NDArray[np.intp]  # (free,) indices of the x_i that have an effect
    m: int

    @property
    def size(self) -> int:
        """Rows of all S_k."""
        return 2 * sum(pencil.N for pencil in self.pencils)

    def full(self, unknowns: Array) -> Array:
        x = np.zeros(self.m)
        x[self.free] = unknowns[:-1]
        return x

    def at(self, unknowns: Array) -> _Point:
        """Stops at the first S_k that is not positive definite."""
        x, found = self.full(unknowns), []
        for pencil in self.pencils:
            found.append(pencil.factor(x, float(unknowns[-1])))
            if found[-1].log_det == -np.inf:
                break
        return _Point(unknowns, tuple(found))

    def derivatives(self, point: _Point, weight: float) -> tuple[Array, Array]:
        """Of weight * gamma - sum of log det S_k, in the free unknowns."""
        pairs = [pencil.derivatives(f) for pencil, f in zip(self.pencils, point.factored, strict=True)]
        keep = np.append(self.free, self.m)
        gradient = np.sum([pair[0] for pair in pairs], axis=0)[keep]
        gradient[-1] += weight
        return gradient, np.sum([pair[1] for pair in pairs], axis=0)[np.ix_(keep, keep)]


def minimise_largest_eigenvalue(pencils: Sequence[Pencil], say: Say = lambda _: None) -> Optimum:
    """The x that minimises the largest value, unique as long as it is determined, else the analytic centre of its set.

    ``say`` hears how near the optimum is in every step. Raises DesignError when the wanted accuracy is not reached.
    """
    m = len(pencils[0].sizes)
    effect = np.any([pencil.active for pencil in pencils], axis=0)
    problem = _Problem(tuple(pencil for pencil in pencils if pencil.N), np.flatnonzero(effect), m)
    start = max((pencil.value(np.zeros(m)) for pencil in problem.pencils), default=0.0)
    if not len(problem.free):
        return Optimum(np.zeros(m), start, start)
    scale = max(1.0, start)
    point = problem.at(np.append(np.zeros(len(problem.free)), start + scale))
    weight = problem.size / scale
    lower = -np.inf
    while weight < problem.size / (GAP * scale):
        weight *= FACTOR
        point = _centre(problem, point, weight, say)
        lower = max(lower, _lower_bound(problem, point, weight))
    x = problem.full(point.unknowns)
    value = max(pencil.value(x) for pencil in problem.pencils)
    allowed = 100 * GAP if problem.size <= LARGE else LOOSE
    if not value - lower <= allowed * scale:
        raise DesignError(
            f"the eigenvalue problem behind (38) was not solved: the best value found is {value:.6g}, but only "
            f"{lower:.6g} is known to be a lower bound. Are the matrices scaled very unevenly?"
        )
    return Optimum(x, value, lower)


def _centre(problem: _Problem, point: _Point, weight: float, say: Say) -> _Point:
    """The minimiser of weight * gamma - log det S by damped Newton steps, from a point with S > 0."""
    for _ in range(100):
        say(f"gamma = {point.unknowns[-1]:.6f}, at most {problem.size / weight:.0e} from the least")
        gradient, hessian = problem.derivatives(point, weight)
        for rcond in RANKS:  # where rounding hides flat directions a step of lower rank leaves them alone
            step = _newton(gradient, hessian, rcond)
            decrement = float(-gradient @ step)
            if decrement < 1e-5:  # the value is then within (size + 0.01) / weight of the least one
                return point
            trial = _search(problem, point, weight, step, decrement)
            if trial is not None:
                break
        if trial is None:
            break  # rounding decides from here on; the certificate tells whether the point is good enough
        point = trial
    return point


def _search(problem: _Problem, point: _Point, weight: float, step: Array, decrement: float) -> _Point | None:
    """The first point along the step, halved again and again, that is as much better as it should be.

    None when only far shorter steps than 1 / (1 + sqrt(decrement)) are: that one suits a self-concordant function.
    """
    length, least = 1.0, 0.1 / (1 + np.sqrt(decrement))
    while length > least:
        trial = problem.at(point.unknowns + length * step)
        if weight * length * step[-1] - trial.log_det + point.log_det <= -0.25 * length * decrement:
            return trial
        length /= 2
    return None


def _newton(gradient: Array, hessian: Array, rcond: float) -> Array:
    unit = 1 / np.sqrt(np.diag(hessian))  # x_i and gamma have different units
    # near the boundary one eigenvector of S decides everything and the Hessian is nearly of rank one
    return -unit * np.linalg.lstsq(hessian * np.outer(unit, unit), unit * gradient, rcond=rcond)[0]


def _lower_bound(problem: _Problem, point: _Point, weight: float) -> float:
    """<F(x'), Z> / tr Z <= the value at any x', for the Z that a Newton step (dx, dgamma) = d gives.

    Z = G - G dS G with G = S^-1 is positive when |G^1/2 dS G^1/2|_F^2 = d'H d < 1. With r = gradient + H d its inner
    products are <F_i, Z> = r_i, tr Z = weight - r_gamma and <S, Z> = size - tr(G dS), so that neither G nor Z is
    needed. r is zero up to rounding, and up to flat directions that a step of lower rank leaves out; it counts against
    the bound over the box that holds every x' as good as this gamma.
    """
    gradient, hessian = problem.derivatives(point, weight)
    x, gamma = point.unknowns[:-1], point.unknowns[-1]
    box = np.min([pencil.reach(gamma) for pencil in problem.pencils], axis=0)[problem.free]
    best = -np.inf
    for rcond in RANKS:
        step = _newton(gradient, hessian, rcond)
        r = gradient + hessian @ step
        trace = weight - r[-1]
        if step @ hessian @ step < 0.99 and trace > 0:
            along = (weight - gradient[-1]) * step[-1] - gradient[:-1] @ step[:-1]  # tr(G dS)
            best = max(best, float(gamma - (problem.size - along + np.abs(r[:-1]) @ (np.abs(x) + box)) / trace))
    return best
