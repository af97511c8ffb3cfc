"""The implicit differentiator: its defining inclusion, exactness while sliding, catching up, and no chatter."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.observers.differentiator import Differentiator

L0, L1 = 1.5 * np.sqrt(2.0), 1.1 * 2.0
numbers = st.floats(-1e3, 1e3, allow_subnormal=False)


def after(a, h, l0=L0, l1=L1):
    """(K, q) rates for the samples a (K, q)."""
    slope = Differentiator(a[0], h, l0, l1)
    return np.array([slope.push(v) for v in a])


@settings(deadline=None, derandomize=True, max_examples=200)
@given(numbers, numbers, numbers, st.floats(1e-3, 0.5), st.floats(0.1, 100), st.floats(0.1, 100))
def test_one_step_solves_the_implicit_equation(z0, z1, a, h, l0, l1):
    """z0+ = z0 + h (z1+ - l0 |e|^1/2 s), z1+ = z1 - h l1 s with e = z0+ - a and s in sgn(e)."""
    slope = Differentiator(np.array([z0]), h, l0, l1)
    slope.rate = np.array([z1])
    slope.push(np.array([a]))
    e, s = (slope._z0 - a)[0], (z1 - slope.rate[0]) / (h * l1)
    size = 1 + abs(z0) + abs(z1) + abs(a)
    assert abs(s) <= 1 + 1e-9 * size / (h * l1)
    if abs(e) > 1e-9 * size:
        assert s == pytest.approx(np.sign(e), abs=1e-9 * size / (h * l1))
    miss = slope._z0[0] - (z0 + h * (slope.rate[0] - l0 * np.sqrt(abs(e)) * np.sign(e)))
    assert abs(miss) < 1e-6 * size + 1e-6 * h * l0 * size


def test_it_is_the_backward_difference_once_it_slides():
    h = 0.01
    t = np.arange(0, 6, h)[:, None]
    a = np.hstack([np.sin(t), 0.5 * np.cos(1.7 * t)])  # |second derivative| at most 1 and 1.445, below 2
    rates = after(a, h)
    late = t[1:, 0] > 2
    np.testing.assert_allclose(rates[1:][late], (np.diff(a, axis=0) / h)[late], atol=1e-12)


def test_it_catches_up_with_a_corner_at_the_slope_it_was_given():
    h = 0.001
    t = np.arange(0, 3, h)[:, None]
    rates = after(np.abs(t - 1), h)[:, 0]
    assert np.abs(rates[t[:, 0] < 0.95][-1] + 1) < 1e-9
    settled = t[np.abs(rates - 1) < 0.05, 0]
    assert 2 / L1 - 0.05 < settled[settled > 1].min() - 1 < 2 * 2 / L1  # the slope changes by 2 at a rate of at most l1
    assert np.abs(rates[-100:] - 1).max() < 1e-9


def test_it_does_not_chatter_where_explicit_euler_does():
    h = 0.01
    t = np.arange(0, 6, h)
    z0, z1, explicit = 0.0, 0.0, []
    for a in np.sin(t):
        e = z0 - a
        z0, z1 = z0 + h * (z1 - L0 * np.sqrt(abs(e)) * np.sign(e)), z1 - h * L1 * np.sign(e)
        explicit.append(z1)
    implicit = after(np.sin(t)[:, None], h)[:, 0]
    late = t > 3
    worst = [np.abs(rate - np.cos(t))[late].max() for rate in (np.array(explicit), implicit)]
    assert worst[1] < 0.51 * h  # half a step of delay
    assert worst[0] > 3 * worst[1]
