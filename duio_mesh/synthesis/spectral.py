"""Coupling gains by the spectral radius of Phi_u itself, where the paper's inequality asks too much (seed 000, (30)).

(38) and (49) make the sum of |U_i'e_i|^2 fall in every step. A stabilising g may let it grow for a while: example 6.1
on a star. The spectral radius is neither convex nor smooth, so this is a search from many starts, and what it finds is
certified by the eigenvalues alone; that it finds nothing proves nothing.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.synthesis.eigenvalue import Say
from duio_mesh.synthesis.lbfgs import Objective, minimise
from duio_mesh.synthesis.pencil import Pencil

STARTS = 16
"""Random directions beside those of the norm's optimum; seeded, so that the same problem has the same answer."""
SAMPLES = 3
"""Gradients at random points near the best g per unknown, when the quasi-Newton method sticks at a kink."""


def radius_and_gradient(pencil: Pencil, g: Array) -> tuple[float, Array]:
    """Spectral radius of Phi_u(g) and its derivative (m,) where the largest eigenvalue is simple."""
    values, left, right = linalg.eig(pencil.phi(g), left=True, right=True, check_finite=False)
    k = int(np.argmax(np.abs(values)))
    radius = float(abs(values[k]))
    x, y = right[:, k], left[:, k]
    slope = np.zeros(len(g))
    across = np.vdot(y, x)
    if radius and abs(across) > 1e-14:
        turn = values[k].conjugate() / radius / across
        by_row = -np.real(
            turn * y.conj() * pencil.heard(x[:, None])[:, 0]
        )  # d lambda = y*(dPhi)x / y*x, dPhi = -J_i T_i dg_i
        np.add.at(slope, np.repeat(np.arange(len(g)), pencil.sizes), by_row)
    return radius, slope


def least_radius(pencil: Pencil, start: Array, say: Say = lambda _: None) -> tuple[Array, float]:
    """The best g (m,) found and its spectral radius, starting from multiples and random neighbours of ``start`` (m,).

    Nodes whose gain has no effect keep 0.
    """
    free = np.flatnonzero(pencil.active)
    if not len(free):
        return np.zeros(len(start)), float(radius_and_gradient(pencil, np.zeros(len(start)))[0])

    def full(x: Array) -> Array:
        g = np.zeros(len(start))
        g[free] = x
        return g

    def objective(x: Array) -> tuple[float, Array]:
        radius, slope = radius_and_gradient(pencil, full(x))
        return radius, slope[free]

    rng = np.random.default_rng(0)
    size = float(np.abs(start).max()) or 1.0
    tries = [factor * start[free] for factor in (1.0, 0.5, 1.5, 2.5)]
    tries += [size * np.exp(rng.normal(0.3, 0.8, len(free))) for _ in range(STARTS)]
    best, least = start[free], objective(start[free])[0]
    for k, x in enumerate(tries):
        say(f"spectral radius {least:.6f} after {k} of {len(tries)} starts")
        found, value = minimise(objective, x, 200, 1e-7)
        if value < least:
            best, least = found, value
    for spread in size * np.geomspace(1e-1, 1e-6, 11):
        for _ in range(20):
            x, value = _sampled_step(objective, best, least, spread, rng)
            if not value < least - 1e-9:
                break
            say(f"spectral radius {value:.6f}")
            best, least = x, value
    return full(best), least


def _sampled_step(
    objective: Objective, x: Array, value: float, spread: float, rng: np.random.Generator
) -> tuple[Array, float]:
    """One step of gradient sampling (Burke, Lewis, Overton 2005): against the shortest mean of gradients around x."""
    near = x + spread * rng.uniform(-1, 1, (SAMPLES * len(x), len(x)))
    gradients = np.array([objective(point)[1] for point in (x, *near)])
    direction = -_shortest(gradients)
    length = 10 * spread / (float(np.linalg.norm(direction)) or 1.0)
    while length * np.linalg.norm(direction) > 1e-3 * spread:
        trial = x + length * direction
        found = objective(trial)[0]
        if found < value:
            return trial, found
        length /= 2
    return x, value


def _shortest(gradients: Array) -> Array:
    """The point of least norm in the convex hull of the rows."""
    from scipy.optimize import nnls

    # min |G'w|^2 with w >= 0 and sum w = 1, the sum as a heavy row (relative weight 1e4)
    heavy = 1e4 * (float(np.abs(gradients).max()) or 1.0)
    stacked = np.vstack([gradients.T, heavy * np.ones(len(gradients))])
    weights, _ = nnls(stacked, np.append(np.zeros(gradients.shape[1]), heavy))
    return np.asarray(weights @ gradients / weights.sum())
