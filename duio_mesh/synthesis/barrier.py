"""A barrier method for the coupling gains on a subspace: a semidefinite program in m + 1 unknowns.

    minimise t   subject to   S_p(g, t) = t I - a + sum_i g_i b_i - sum_i g_i^2 c_i / (1 or t) >= 0   for every p

by damped Newton steps on w t - sum_p log det S_p (which is self-concordant), with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.synthesis.pencil import Reduced

GROWTH = 10.0
"""The weight of t against the barrier grows by this."""
STEPS = 60
"""Newton steps per weight."""

Say = Callable[[str], None]


class Centre(NamedTuple):
    """Where the barrier method stopped."""

    g: Array  # (m,)
    t: float
    lower: float  # no g has a smaller t, in the reduced problem or in the whole one


class _Point(NamedTuple):
    z: Array  # (m + 1,): g and t
    factors: list[Array]  # lower Cholesky factors of all S_p; empty where one of them is not positive definite
    value: float  # -sum of log det S_p


def minimise(problems: Sequence[Reduced], g: Array, t: float, gap: float, say: Say = lambda _: None) -> Centre:
    """From g (m,) and a t that is nearly feasible, until t is within ``gap`` of the least."""
    k = sum(problem.k for problem in problems)
    margin = max(1e-3 * t, gap)
    point = _at(problems, np.append(g, t + margin))
    while not point.factors:
        margin *= 4
        point = _at(problems, np.append(g, t + margin))
    weight, lower = k / max(10 * margin, gap), -np.inf
    while True:
        say(f"{point.z[-1] - lower:.0e} from the least")
        for _ in range(STEPS):
            gradient, hessian, bound = _derivatives(problems, point, weight)
            lower = max(lower, bound)
            step = _newton(gradient, hessian)
            decrement = float(-gradient @ step)
            if decrement < 1e-6:
                break
            better = _search(problems, point, weight, step, decrement)
            if better is None:
                break  # rounding decides from here on
            point = better
        if point.z[-1] - lower <= gap or weight > 100 * k / gap:
            return Centre(point.z[:-1], float(point.z[-1]), lower)
        weight *= GROWTH


def _at(problems: Sequence[Reduced], z: Array) -> _Point:
    """Everything factored, or nothing when z is not feasible."""
    g, t = z[:-1], float(z[-1])
    if not t > 0:
        return _Point(z, [], np.inf)
    factors, value = [], 0.0
    for a, b, c, criterion in problems:
        S = np.tensordot(g, b, 1) - np.tensordot(g * g / (t if criterion == "paper" else 1.0), c, 1) - a
        S[np.diag_indices(len(a))] += t
        try:
            factors.append(linalg.cholesky(S, lower=True, check_finite=False))
        except linalg.LinAlgError:
            return _Point(z, [], np.inf)
        value -= 2 * float(np.log(np.diag(factors[-1])).sum())
    return _Point(z, factors, value)


def _derivatives(problems: Sequence[Reduced], point: _Point, weight: float) -> tuple[Array, Array, float]:
    """Gradient and Hessian of w t - sum log det S_p in (g, t), and the lower bound that the inverses G_p give.

    <S_p, G_p> >= 0 for every feasible (g', t'), so t' sum tr G >= alpha - 2 g'beta + g'^2 kappa / (1 or t'), with the
    inner products of G with a, b / 2 and c. The right side is least at g' = beta / kappa (times t'): no other g' needs
    to be looked at, and the bound holds whether the point is on the central path or not.
    """
    g, t = point.z[:-1], float(point.z[-1])
    m = len(g)
    gradient, hessian = np.append(np.zeros(m), weight), np.zeros((m + 1, m + 1))
    alpha, beta, kappa, trace = 0.0, np.zeros(m), np.zeros(m), 0.0
    paper = problems[0].criterion == "paper"
    c0, c1 = (t, 1.0) if paper else (1.0, 0.0)  # c, and its derivative in t
    for (a, b, c, _), L in zip(problems, point.factors, strict=True):
        k = len(a)
        G = linalg.cho_solve((L, True), np.eye(k), check_finite=False)
        flat = G.ravel()
        in_b, in_c = b.reshape(m, -1) @ flat, c.reshape(m, -1) @ flat
        alpha, beta, kappa, trace = alpha + float(a.ravel() @ flat), beta + in_b / 2, kappa + in_c, trace + np.trace(G)
        slopes = np.concatenate([b - (2 * g / c0)[:, None, None] * c, np.zeros((1, k, k))])  # of S in g and t
        slopes[m] = np.eye(k) + np.tensordot(g * g * c1 / c0**2, c, 1)
        product = (G @ slopes.transpose(1, 0, 2).reshape(k, -1)).reshape(k, m + 1, k).transpose(1, 0, 2)
        gradient -= np.trace(product, axis1=1, axis2=2)
        hessian += product.reshape(m + 1, -1) @ product.transpose(0, 2, 1).reshape(m + 1, -1).T
        bend = -2 * g * c1 / c0**2 * in_c
        hessian[np.arange(m), np.arange(m)] += 2 * in_c / c0
        hessian[:m, m] += bend
        hessian[m, :m] += bend
        hessian[m, m] += 2 * c1 / c0**3 * float(g * g @ in_c)
    gained = float(np.sum(np.divide(beta * beta, kappa, out=np.zeros(m), where=kappa > 0)))
    lower = alpha / (trace + gained) if paper else (alpha - gained) / trace
    return gradient, hessian, lower


def _newton(gradient: Array, hessian: Array) -> Array:
    """-H^-1 gradient in scaled unknowns (g and t have different units); flat directions are left alone."""
    diagonal = np.diag(hessian)
    unit = np.divide(1.0, np.sqrt(np.maximum(diagonal, 0)), out=np.zeros(len(diagonal)), where=diagonal > 0)
    return np.asarray(-unit * np.linalg.lstsq(hessian * np.outer(unit, unit), unit * gradient, rcond=1e-14)[0])


def _search(problems: Sequence[Reduced], point: _Point, weight: float, step: Array, decrement: float) -> _Point | None:
    """The first point along the step, halved again and again, that is as much better as it should be.

    None when only far shorter steps than 1 / (1 + sqrt(decrement)) are: that one suits a self-concordant function.
    """
    length, least = 1.0, 0.1 / (1 + np.sqrt(decrement))
    while length > least:
        trial = _at(problems, point.z + length * step)
        if trial.factors and weight * length * step[-1] + trial.value - point.value <= -0.25 * length * decrement:
            return trial
        length /= 2
    return None
