"""Exact propagation under each hold, the stacked error system, and the choice of a coupling gain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from duio_mesh import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.observers.hold import History
from duio_mesh.synthesis.sampled import (
    Coupled,
    HoldOptions,
    Local,
    abscissa,
    choose_gain,
    error_system,
    largest_step,
    sampled,
)

DEGREE = {"zero_order": 0, "first_order": 1, "quadratic": 2}


@settings(deadline=None, derandomize=True, max_examples=25)
@given(st.integers(0, 10**6), st.sampled_from(sorted(DEGREE)), st.sampled_from([None, *sorted(DEGREE)]))
def test_polynomials_up_to_the_degree_of_the_hold_are_integrated_exactly(seed, hold, input_hold):
    """y and u are polynomials of time of their hold's degree (constant from the last tick on for zero_order)."""
    rng = np.random.default_rng(seed)
    k, p, m, c = rng.integers(1, 5), rng.integers(1, 4), rng.integers(0, 3), rng.integers(1, 3)
    local = Local(*(rng.standard_normal(shape) for shape in ((k, k), (k, p), (k, m), (k, c), (k,))))
    h, push, start = 0.3, rng.standard_normal(c), rng.standard_normal(k)
    of_y, of_u = (rng.standard_normal((DEGREE[name] + 1, size)) for name, size in ((hold, p), (input_hold or hold, m)))
    y, u = (lambda t, w=w: sum((w[j] * t**j for j in range(len(w))), np.zeros(w.shape[1])) for w in (of_y, of_u))
    step = sampled(local, h, HoldOptions(hold=hold, input_hold=input_hold))
    history = History(p + m, step.Gamma.shape[1] // (p + m))
    assert not history.push(y(-h), u(-h))
    assert history.push(y(0.0), u(0.0))
    history.push(y(h), u(h))
    found = step.Phi @ start + step.Gamma @ history.samples + step.K @ push + step.bias
    rhs = lambda t, s: local.A @ s + local.Y @ y(t) + local.U @ u(t) + local.K @ push + local.bias  # noqa: E731
    expected = solve_ivp(rhs, (0, h), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_the_first_interval_of_a_quadratic_hold_is_a_straight_line():
    history = History(2, 3)
    history.push(np.array([1.0]), np.array([10.0]))
    history.push(np.array([4.0]), np.array([8.0]))
    np.testing.assert_array_equal(history.samples, [4, 8, 1, 10, -2, 12])
    history.push(np.array([5.0]), np.array([9.0]))
    np.testing.assert_array_equal(history.samples, [5, 9, 4, 8, 1, 10])


def integrators(gain):
    """Two agreeing scalar observers of an unstable mode: e_i' = 0.5 e_i on node 1, -2 e_2 on node 2."""
    one = np.eye(1)
    return error_system(
        [Coupled(0.5 * one, one, gain * one, one), Coupled(-2 * one, one, gain * one, one)],
        np.array([[1.0, -1.0], [-1.0, 1.0]]),
    )


def sampled_integrators(gain, h):
    nodes = []
    for a in (0.5, -2.0):
        local = Local(np.array([[a]]), np.zeros((1, 1)), np.zeros((1, 0)), np.eye(1), np.zeros(1))
        step = sampled(local, h, HoldOptions())
        nodes.append(Coupled(step.Phi, step.K, gain * np.eye(1), np.eye(1)))
    return spectral_radius(error_system(nodes, np.array([[1.0, -1.0], [-1.0, 1.0]])))


def test_error_system_by_hand():
    np.testing.assert_allclose(integrators(3.0), [[0.5 - 3, 3], [3, -2 - 3]])
    np.testing.assert_allclose(abscissa(integrators(1e6)), -0.75, atol=1e-5)  # locked together: the mean


def test_gains_are_chosen_refused_and_keep_a_distance_to_the_longest_step():
    L, growth = np.array([[1.0, -1.0], [-1.0, 1.0]]), lambda gain: abscissa(integrators(gain))
    c = choose_gain("c", "auto", growth, sampled_integrators, 0.05, L)
    best = min(sampled_integrators(gain, 0.05) for gain in np.geomspace(0.01, 20, 400))
    assert np.log(sampled_integrators(c, 0.05)) < 0.9 * np.log(best)
    assert sampled_integrators(c, 1.5 * 0.05) < 1
    assert choose_gain("c", 2.0, growth, sampled_integrators, 0.05, L) == 2.0
    limit = largest_step(lambda h: sampled_integrators(2.0, h), 0.05)
    assert sampled_integrators(2.0, limit) < 1 < sampled_integrators(2.0, 1.02 * limit)
    with pytest.raises(DesignError, match=r"c = 0.5 is unstable at any step: .* real part 0\.\d+"):
        choose_gain("c", 0.5, growth, sampled_integrators, 0.05, L)
    with pytest.raises(DesignError, match=r"c = 30 is unstable at run\.step = 0\.05 s: .* is [1-9]\.\d+"):
        choose_gain("c", 30.0, growth, sampled_integrators, 0.05, L)
    with pytest.raises(DesignError, match=r"no c between .* its least spectral radius is 7\.766"):
        choose_gain("c", "auto", growth, sampled_integrators, 5.0, L)


def test_nobody_to_listen_to_needs_no_gain():
    assert choose_gain("c", "auto", lambda _: 1.0, lambda _, __: 2.0, 0.1, np.zeros((1, 1))) == 0.0


@pytest.mark.parametrize("wanted", ["auto", 2.0])
def test_a_gain_that_is_stable_by_rounding_only_is_refused(wanted):
    L = np.array([[1.0, -1.0], [-1.0, 1.0]])
    with pytest.raises(DesignError, match=r"cannot help; use an axe|at any step.* or an axe"):
        choose_gain("c", wanted, lambda _: -1e-16, lambda _, __: 1 - 1e-15, 0.1, L, "an axe")
    with pytest.raises(DesignError, match=r"no c .* Use a shorter step|unstable at run\.step = 0\.1 s"):
        choose_gain("c", wanted, lambda _: -1.0, lambda _, __: 1 - 1e-15, 0.1, L)
    assert largest_step(lambda h: 1 - 1e-15, 0.1) == 0
