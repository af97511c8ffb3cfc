"""L-BFGS for functions that are infinite outside an open set, such as an H2 norm outside the stabilising gains.

scipy's L-BFGS-B interpolates in its line search; at the border of the domain the values are infinite, it stalls and
returns its start. Here the step is bisected on the weak Wolfe conditions only (Lewis and Overton, "Nonsmooth
optimization via quasi-Newton methods", 2013), which needs nothing but the comparison "not smaller".
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from duio_mesh.arrays import Array

Objective = Callable[[Array], tuple[float, Array]]

_MEMORY = 20
_DECREASE, _CURVATURE = 1e-4, 0.9  # weak Wolfe
_BISECTIONS = 40
_LOOKBACK = 10


def minimise(objective: Objective, x: Array, iterations: int, rtol: float) -> tuple[Array, float]:
    """A local minimiser and its value, from a start with a finite value.

    ``objective`` returns value and gradient; outside its domain the value is inf and the gradient is not looked at.
    Stops when ten iterations together gain less than ``rtol`` times the value, or no descent is possible any more.
    """
    f, g = objective(x)
    pairs: list[tuple[Array, Array, float]] = []
    history = [f]
    for _ in range(iterations):
        d = _direction(g, pairs)
        if not d @ g < 0:
            break
        found = _search(objective, x, f, g, d)
        if found is None:
            if not pairs:
                break
            pairs.clear()  # the curvature is stale: once more along the gradient
            continue
        step, f, new = found
        s, y = step * d, new - g
        if s @ y > 1e-14 * np.linalg.norm(s) * np.linalg.norm(y):
            pairs = [*pairs, (s, y, 1.0 / float(s @ y))][-_MEMORY:]
        x, g = x + s, new
        history.append(f)
        if len(history) > _LOOKBACK and history[-1 - _LOOKBACK] - f <= rtol * abs(f):
            break
    return x, f


def _direction(g: Array, pairs: list[tuple[Array, Array, float]]) -> Array:
    """-B g with the inverse Hessian estimate of the pairs (two-loop recursion)."""
    q, alphas = g.copy(), []
    for s, y, r in reversed(pairs):
        alphas.append(r * float(s @ q))
        q -= alphas[-1] * y
    if pairs:
        _, y, r = pairs[-1]
        q /= r * float(y @ y)
    else:
        q *= min(1.0, 0.1 / max(float(np.linalg.norm(g)), 1e-300))  # a first step of length 0.1 at most
    for (s, y, r), alpha in zip(pairs, reversed(alphas), strict=True):
        q += s * (alpha - r * float(y @ q))
    return -q


def _search(objective: Objective, x: Array, f: float, g: Array, d: Array) -> tuple[float, float, Array] | None:
    """(step, value, gradient) under the weak Wolfe conditions, or at least a decrease; None without any."""
    slope = float(g @ d)
    low, high, step = 0.0, np.inf, 1.0
    best: tuple[float, float, Array] | None = None
    for _ in range(_BISECTIONS):
        value, gradient = objective(x + step * d)
        if not value <= f + _DECREASE * step * slope:
            high = step
        else:
            best = (step, value, gradient)
            if gradient @ d >= _CURVATURE * slope:
                break
            low = step
        step = (low + high) / 2 if np.isfinite(high) else 2 * low
    return best
