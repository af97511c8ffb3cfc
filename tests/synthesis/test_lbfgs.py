"""The minimiser on textbook functions and on one that is infinite outside an open set."""

from __future__ import annotations

import numpy as np
from scipy import optimize

from duio_mesh.synthesis.lbfgs import minimise


def test_rosenbrock():
    x, f = minimise(lambda x: (optimize.rosen(x), optimize.rosen_der(x)), np.full(8, -1.2), 1000, rtol=0.0)
    np.testing.assert_allclose(x, 1.0, atol=1e-6)
    assert f < 1e-12


def test_the_domain_may_end():
    """min sum x - sum log(b - A x): the analytic optimum of a barrier, starting next to the wall."""
    rng = np.random.default_rng(0)
    A, b = np.vstack([np.eye(5), -np.eye(5), rng.standard_normal((10, 5))]), np.ones(20)

    def barrier(x):
        slack = b - A @ x
        if (slack <= 0).any():
            return np.inf, x
        return float(x.sum() - np.log(slack).sum()), np.ones(5) + A.T @ (1 / slack)

    direction = rng.standard_normal(5)
    step = 1 / (A @ direction).max()
    x, f = minimise(barrier, 0.999999 * step * direction, 500, rtol=1e-15)
    exact = optimize.minimize(
        lambda x: barrier(x)[0],
        np.zeros(5),
        method="Nelder-Mead",
        options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 10_000},
    )
    assert f <= exact.fun + 1e-9
    np.testing.assert_allclose(x, exact.x, atol=1e-4)


def test_a_minimiser_stays_and_a_kink_ends_the_search():
    x, f = minimise(lambda x: (float(x @ x), 2 * x), np.zeros(3), 10, rtol=0.0)
    assert not x.any()
    assert f == 0
    x, f = minimise(lambda x: (float(np.abs(x).sum()), np.sign(x)), np.array([3.0, -2.0]), 500, rtol=0.0)
    assert f < 1e-6
