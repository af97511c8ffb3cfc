"""The algebra of subspaces against what was planted, and against its own laws."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planted import basis_change

from duio_mesh.geometry import (
    GeometryError,
    add,
    complement,
    contains,
    excess,
    gap,
    image,
    intersection,
    kernel,
    preimage,
    quotient,
    rank,
    unobservable_subspace,
)

TIGHT = 1e-11


@st.composite
def planted_pairs(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int, int]:
    """A basis T and sizes a, c, b: V = first a + c columns, W = columns a .. a + c + b; they share c of them."""
    a, c, b, rest = (draw(st.integers(0, 4)) for _ in range(4))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    T = basis_change(rng, max(1, a + b + c + rest))
    return image(T[:, : a + c]), image(T[:, a : a + c + b]), T, a, c, b


@settings(max_examples=100, deadline=None, derandomize=True)
@given(planted_pairs())
def test_sum_and_intersection_find_what_was_planted(case: tuple) -> None:
    V, W, T, a, c, b = case
    common, both = intersection(V, W), add(V, W)
    assert gap(common, image(T[:, a : a + c])) < TIGHT
    assert gap(both, image(T[:, : a + c + b])) < TIGHT
    assert np.array_equal(both[:, : V.shape[1]], V)
    for basis in (common, both, complement(V)):
        assert np.abs(basis.T @ basis - np.eye(basis.shape[1])).max(initial=0.0) < 1e-14
    # de Morgan: the complement of a sum is the intersection of the complements
    assert gap(complement(both), intersection(complement(V), complement(W))) < TIGHT
    assert contains(both, V)
    assert contains(V, common)
    assert (excess(V, W) < TIGHT) == (a == 0)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(planted_pairs(), st.integers(0, 3))
def test_preimage_kernel_and_quotient(case: tuple, defect: int) -> None:
    V, _, T, *_ = case
    n = len(T)
    A = T @ np.diag(np.r_[np.zeros(min(defect, n)), np.ones(n - min(defect, n))]) @ np.linalg.inv(T)
    assert gap(kernel(A), image(T[:, : min(defect, n)])) < TIGHT
    back = preimage(A, V)
    assert back.shape[1] == kernel(A).shape[1] + intersection(V, image(A)).shape[1]
    assert excess(image(A @ back, scale=1.0), V) < 1e-9
    P = quotient(V)
    assert P.shape == (n - V.shape[1], n)
    assert np.abs(P @ V).max(initial=0.0) < 1e-14


def test_rank_tells_how_clear_it_was() -> None:
    decided = rank(np.diag([4.0, 1.0, 4e-7, 4e-12, 0.0]))
    assert decided.rank == 3
    assert decided.kept == pytest.approx(1e-7)
    assert decided.dropped == pytest.approx(1e-12)
    assert rank(np.diag([4e-12, 0.0]), scale=1.0).rank == 0  # rounding errors alone have no rank
    assert rank(np.zeros((3, 2))) == (0, np.inf, 0.0)
    assert rank(np.zeros((0, 2))).rank == 0


def test_small_gap_is_measured_not_rounded() -> None:
    turned = np.array([[np.cos(1e-7)], [np.sin(1e-7)]])
    assert gap(np.array([[1.0], [0.0]]), turned) == pytest.approx(1e-7, rel=1e-6)
    assert gap(np.eye(2)[:, :1], np.eye(2)) == 1.0
    assert gap(np.zeros((2, 0)), np.zeros((2, 0))) == 0.0


@pytest.mark.parametrize(
    ("C", "A", "words"),
    [
        (np.eye(2), np.zeros((2, 3)), r"A has shape \(2, 3\)"),
        (np.eye(3), np.eye(2), r"C has shape \(3, 3\)"),
        (np.array([[np.nan, 0.0]]), np.eye(2), "C holds NaN"),
        (np.zeros(2), np.eye(2), "C has shape"),
    ],
)
def test_wrong_shapes_and_nan_are_named(C: np.ndarray, A: np.ndarray, words: str) -> None:
    with pytest.raises(GeometryError, match=words):
        unobservable_subspace(C, A)
