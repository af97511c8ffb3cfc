"""Unknown-input decoupling of one node (seed 000, (6)-(10))."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.errors import DesignError
from duio_mesh.synthesis.uio import decouple


def random_pair(seed: int, n: int, p: int, r: int):
    rng = np.random.default_rng(seed)
    return rng, rng.standard_normal((p, n)), rng.standard_normal((n, r))


@given(st.integers(0, 10**6), st.integers(1, 8), st.data())
@settings(deadline=None, derandomize=True, max_examples=60)
def test_takes_the_unknown_inputs_out_and_nothing_else(seed, n, data):
    p = data.draw(st.integers(1, n))
    r = data.draw(st.integers(0, p))
    rng, C, B = random_pair(seed, n, p, r)
    mixed = np.hstack([B @ rng.standard_normal((r, 2)), np.zeros((n, 1)), B])  # dependent, zero, then the columns
    found = decouple(C, mixed)
    scale = 1e-13 * (1 + np.linalg.norm(found.E) * np.linalg.norm(C)) ** 2
    np.testing.assert_allclose(found.P @ B, 0, atol=10 * scale)
    np.testing.assert_allclose(found.P @ found.P, found.P, atol=scale)
    assert np.linalg.matrix_rank(found.P, tol=1e-8) == n - r  # ker P = im B: as much of the state as possible is left
    np.testing.assert_allclose(found.P, np.eye(n) + found.E @ C, atol=0)
    if r:  # (8)-(9) on the independent columns themselves
        CB = C @ B
        np.testing.assert_allclose(
            found.E, -B @ np.linalg.inv(CB.T @ CB) @ CB.T, rtol=1e-5, atol=1e-9 * np.linalg.norm(found.E)
        )


def test_margins_do_not_depend_on_units():
    _, C, B = random_pair(3, 6, 3, 2)
    plain = decouple(C, B).margins
    scaled = decouple(np.diag([1e-5, 1.0, 1e6]) @ C, B * [1e4, 1e-6]).margins
    for name in ("output_rank", "unknown_input_rank", "decoupling_rank"):
        assert scaled[name] == pytest.approx(plain[name], rel=1e-6)


def test_margin_shrinks_with_the_distance_from_rank_loss():
    C = np.eye(2, 3)
    margins = [decouple(C, np.array([[1.0, 1.0], [0.0, far], [1.0, 0.0]])).margins for far in (1.0, 1e-3, 1e-6)]
    values = [m["decoupling_rank"] for m in margins]
    assert values[0] > 0.1
    assert values[1] == pytest.approx(1e-3, rel=0.5)
    assert values[2] == pytest.approx(1e-6, rel=0.5)


@pytest.mark.parametrize("Bbar", [np.zeros((4, 0)), np.zeros((4, 3))])
def test_without_unknown_inputs_nothing_is_changed(Bbar):
    found = decouple(np.eye(2, 4), Bbar)
    assert not found.E.any()
    np.testing.assert_array_equal(found.P, np.eye(4))
    assert found.basis.shape == (4, 0)


def test_rounding_errors_are_not_an_unknown_input():
    B = np.array([[1.0, 1e-17], [0.0, 3e-17], [0.0, -2e-17]])
    assert decouple(np.eye(2, 3), B).basis.shape == (3, 1)


def test_says_who_cannot_be_decoupled_from_what():
    C, B = np.array([[1.0, 0.0, 0.0]]), np.eye(3)[:, :2]
    with pytest.raises(DesignError, match=r"node 7: Assumption 2 fails.*= 1, but rank\(B_iw\) = 2.*valve, leak") as e:
        decouple(C, B, "node 7", ["valve", "leak"])
    assert "More unknown inputs than measurements (1)" in str(e.value)
    with pytest.raises(DesignError, match=r"= 0, but rank\(B_iw\) = 1.*\[0\]"):
        decouple(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), np.eye(3)[:, :1])
