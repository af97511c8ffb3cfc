"""Observability and detectability decompositions: planted, against SLICOT, and on the papers' examples."""

from __future__ import annotations

import numpy as np
import pytest
import slycot
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from papers import uio_pairs
from planted import unobservable

from duio_mesh.geometry import (
    Decomposition,
    contains,
    detectability_decomposition,
    gap,
    observability_decomposition,
    stable_abscissa,
    stable_radius,
    unobservable_subspace,
)

PRECISE = 1e-9

# apart from each other: two equal eigenvalues would hide one direction from a single output
GRID = [
    complex(round(r * np.cos(a), 12), round(r * np.sin(a), 12)) for r in (0.3, 0.6, 0.9) for a in (0, 1.1, 2.0, np.pi)
]


@st.composite
def planted(draw: st.DrawFn, largest: int = 5) -> tuple:
    """(C, A, U, Ub): up to 30 states, unobservable eigenvalues on both sides of the unit circle."""

    def eigenvalues(smallest: int) -> list[complex]:
        return draw(st.lists(st.sampled_from(GRID), min_size=smallest, max_size=largest, unique=True))

    seen, good, bad = eigenvalues(1), eigenvalues(0), [v / abs(v) ** 2 for v in eigenvalues(0)]
    p = draw(st.integers(1, 3))
    return unobservable(np.random.default_rng(draw(st.integers(0, 2**32 - 1))), seen, good, bad, p)


def check_blocks(C: np.ndarray, A: np.ndarray, found: Decomposition) -> None:
    """[D U] is orthogonal, C U = 0 and D' A U = 0."""
    D, U = found.D, found.U
    T, size = np.hstack([D, U]), max(1.0, np.linalg.norm(A, 2), np.linalg.norm(C, 2))
    assert np.abs(T.T @ T - np.eye(len(A))).max() < 1e-13
    assert np.abs(C @ U).max(initial=0.0) < PRECISE * size
    assert np.abs(D.T @ A @ U).max(initial=0.0) < PRECISE * size


@settings(max_examples=150, deadline=None, derandomize=True)
@given(planted())
def test_finds_the_planted_subspaces(case: tuple) -> None:
    C, A, U, bad = case
    whole = observability_decomposition(C, A)
    # one output and ten modes can be planted so faintly that no tolerance separates them from noise: the margins say so
    assume(whole.rank.kept > 1e-6 and whole.rank.dropped < 1e-11)
    undetectable = detectability_decomposition(C, A, stable_radius())
    assert (whole.nu, undetectable.nu) == (U.shape[1], bad.shape[1])
    assert gap(whole.U, U) < 1e-7
    assert gap(undetectable.U, bad) < 1e-7
    assert contains(whole.U, undetectable.U)
    assert (np.abs(undetectable.eigenvalues) > 1.0).all()
    check_blocks(C, A, whole)
    check_blocks(C, A, undetectable)
    # what is left is detectable
    D = undetectable.D
    assert detectability_decomposition(C @ D, D.T @ A @ D, stable_radius()).nu == 0


@settings(max_examples=100, deadline=None, derandomize=True)
@given(planted())
def test_agrees_with_slicot(case: tuple) -> None:
    C, A, *_ = case
    n, p = len(A), len(C)
    found = observability_decomposition(C, A)
    assume(found.rank.kept > 1e-7)  # the two scale their tolerances differently: compare where the rank is clear
    *_, seen, _, _, Z, _ = slycot.ab01nd(n, p, A.T.copy(), C.T.copy(), jobz="I", tol=1e-9)
    assert found.nu == n - seen
    assert gap(found.U, Z[:, seen:]) < 1e-7


@pytest.mark.parametrize("seed", range(5))
def test_large_and_fast_where_powers_of_A_lose_all_digits(seed: int) -> None:
    """n = 30 and eigenvalues up to 3: A^29 spans 14 decades, the kernel of the observability matrix is noise."""
    rng = np.random.default_rng(seed)
    seen = list(rng.uniform(-3, 3, 16))
    good, bad = list(rng.uniform(-0.9, 0.9, 8)), list(rng.uniform(1.2, 3, 6))
    C, A, U, Ub = unobservable(rng, seen, good, bad, 3)
    found, undetectable = observability_decomposition(C, A), detectability_decomposition(C, A, stable_radius())
    assert (found.nu, undetectable.nu) == (14, 6)
    assert gap(found.U, U) < 1e-9
    assert gap(undetectable.U, Ub) < 1e-8
    assert found.rank.kept > 1e-6
    assert found.rank.dropped < 1e-11


def test_continuous_region_and_explicit_margin() -> None:
    A = np.diag([-1.0, 0.0, 0.5, -1e-3])
    C = np.array([[1.0, 0.0, 0.0, 0.0]])
    assert detectability_decomposition(C, A, stable_abscissa()).nu == 2
    assert detectability_decomposition(C, A, stable_abscissa(-0.01)).nu == 3
    assert observability_decomposition(C, A).nu == 3


def test_a_double_eigenvalue_near_the_bound_is_not_torn() -> None:
    """Rounding splits a double integrator's eigenvalue 1 into 1 +- 1e-8; half of it must not count as stable."""
    torn = 0
    for seed in range(20):
        Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
        A = Q @ np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.5]]) @ Q.T
        assert detectability_decomposition(np.zeros((1, 3)), A, stable_radius()).nu == 2
        torn += np.count_nonzero(np.abs(np.linalg.eigvals(A)) >= 1 - 1e-9) == 1
    assert torn > 0  # the trap is real: one by one, the eigenvalues of some of these would be classified apart


def test_extremes() -> None:
    A = np.diag([2.0, 0.5])
    nothing_seen = detectability_decomposition(np.zeros((0, 2)), A, stable_radius())
    assert nothing_seen.nu == 1
    assert np.abs(nothing_seen.U[:, 0]) == pytest.approx([1.0, 0.0])
    assert observability_decomposition(np.zeros((0, 2)), A).nu == 2
    assert observability_decomposition(np.eye(2), A).nu == 0
    assert unobservable_subspace(np.array([[0.0, 1.0]]), np.zeros((2, 2))).shape == (2, 1)
    # outputs in units of their own do not change the answer
    mixed = np.array([[1e-3, 0.0], [0.0, 1e5]])
    assert observability_decomposition(mixed, A).nu == 0


def test_heat_example_of_seed_000() -> None:
    pairs = uio_pairs("ring.yaml")
    found = {i: observability_decomposition(*pair) for i, pair in pairs.items()}
    assert [d.nu for d in found.values()] == [6, 6, 6, 5]
    assert [detectability_decomposition(*pair, stable_radius()).nu for pair in pairs.values()] == [0, 0, 0, 0]
    # seed 000: || U' A U ||, as measured in the notes
    norms = [np.linalg.norm(d.U.T @ pairs[i][1] @ d.U, 2) for i, d in found.items()]
    assert norms == pytest.approx([0.9369, 0.9541, 0.9263, 0.9263], abs=5e-5)


def test_six_state_example_of_seed_000() -> None:
    pairs = uio_pairs("six_state_ring.yaml")
    for decompose in (observability_decomposition, lambda C, A: detectability_decomposition(C, A, stable_radius())):
        assert [decompose(*pair).nu for pair in pairs.values()] == [4, 1, 4, 3, 2]
    # node 2 sees some directions hardly: the margin says so and is still a million times the tolerance
    assert 1e-3 < observability_decomposition(*pairs[2]).rank.kept < 2e-3


@pytest.mark.parametrize(("side", "speed"), [(5, 0.6), (7, 0.3)])
def test_symmetric_heat_grid(side: int, speed: float) -> None:
    """A square room grid seen from two opposite corners: modes antisymmetric about a diagonal are unobservable.

    Rounding grows along the staircase (up to 1e-8 at speed 0.3): the answer must not depend on rtol all the same.
    """
    path = np.diag(np.r_[1.0, np.full(side - 2, 2.0), 1.0]) - np.eye(side, k=1) - np.eye(side, k=-1)
    L = np.kron(path, np.eye(side)) + np.kron(np.eye(side), path)
    w, V = np.linalg.eigh(L)
    A = V @ np.diag(np.exp(-speed * w)) @ V.T
    C = np.zeros((2, side * side))
    C[0, 0] = C[1, -1] = 1.0
    # an independent count: an eigenspace of a symmetric matrix is seen in rank(C V) directions
    eigenspaces = np.split(np.arange(side * side), np.flatnonzero(np.diff(w) > 1e-9) + 1)
    seen = sum(np.linalg.matrix_rank(C @ V[:, group], tol=1e-9) for group in eigenspaces)
    for rtol in (1e-12, 1e-9, 1e-6):
        found = observability_decomposition(C, A, rtol)
        assert found.nu == side * side - seen
        assert np.abs(C @ found.U).max() < 1e-6
        assert np.abs(found.D.T @ A @ found.U).max() < 1e-6
