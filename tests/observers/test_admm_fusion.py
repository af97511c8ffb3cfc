"""The fusions themselves: bits that do not depend on the block width, and solutions against least squares."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from duio_mesh.observers.blocks import ColumnProduct, sum_rows
from duio_mesh.observers.fusion import FiniteTimeAverage, Fusion, fusion_rounds, make_fusion
from duio_mesh.synthesis.admm_rates import spectrum

ADMM = {"fusion": "admm", "gamma": 0.5, "nu": 12, "alpha_factor": 1.0}
RELAXED = {"fusion": "relaxed", "c": 0.01, "rounds": 12}


class Case:
    """A random connected weighted graph of N nodes with random T_i that see R^n together."""

    def __init__(self, seed: int, N: int, n: int, weighted: bool = True) -> None:
        rng = np.random.default_rng(seed)
        W = np.zeros((N, N))
        for i in range(1, N):
            j = int(rng.integers(i))
            W[i, j] = W[j, i] = 1.0
        extra = np.triu(rng.random((N, N)) < 0.3, 1)
        W = np.maximum(W, extra + extra.T)
        if weighted:
            scale = np.triu(rng.uniform(0.5, 2.0, (N, N)), 1)
            W = W * (scale + scale.T)
        self.rng, self.N, self.n, self.W = rng, N, n, W
        self.L = np.diag(W.sum(axis=1)) - W
        self.T = [rng.standard_normal((int(rng.integers(0, 4)), n)) for _ in range(N)]
        self.T[0] = rng.standard_normal((n + 1, n))
        self.H = sum(T.T @ T for T in self.T)
        self.inverse = np.linalg.inv(self.H)
        self.finite = {"fusion": "finite_time", "island_size": N, "eigenvalues": spectrum(self.L)}

    def hears(self, i: int) -> dict[int, float]:
        return {j: float(self.W[i, j]) for j in range(self.N) if self.W[i, j]}

    def fusions(self, options: dict, width: int, normalised: bool = True) -> list[Fusion]:
        inverse = self.inverse if normalised else None
        return [make_fusion(self.T[i], inverse, self.hears(i), options, width) for i in range(self.N)]

    def measured(self, width: int, consistent: bool) -> list[np.ndarray]:
        """xi_i as (r_i, width)."""
        x = self.rng.standard_normal((self.n, width))
        noise = 0.0 if consistent else 0.3
        return [T @ x + noise * self.rng.standard_normal((len(T), width)) for T in self.T]

    def least_squares(self, xi: list[np.ndarray]) -> np.ndarray:
        return np.linalg.lstsq(np.vstack(self.T), np.vstack(xi), rcond=None)[0]


def run(case: Case, nodes: list[Fusion], xi: list[np.ndarray], options: dict, lost: Callable = lambda: False) -> list:
    """Lockstep; returns (n, W) per node."""
    for node, own in zip(nodes, xi, strict=True):
        node.begin(own.reshape(-1))
    for r in range(fusion_rounds(options)):
        sent = [node.message(r).copy() for node in nodes]
        for i, node in enumerate(nodes):
            node.exchange(r, {j: sent[j] for j in case.hears(i) if not lost()})
    return [node.state.reshape(case.n, -1).copy() for node in nodes]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    N=st.integers(1, 5),
    n=st.integers(1, 9),
    width=st.integers(2, 40),
    kind=st.sampled_from(["admm", "plain", "finite_time", "relaxed"]),
)
def test_bits_do_not_depend_on_the_width(seed: int, N: int, n: int, width: int, kind: str) -> None:
    case = Case(seed, N, n)
    options = {"admm": ADMM, "plain": ADMM, "finite_time": case.finite, "relaxed": RELAXED}[kind]
    xi = case.measured(width, consistent=False)
    together = run(case, case.fusions(options, width, kind != "plain"), xi, options)
    single = case.fusions(options, 1, kind != "plain")  # one set of nodes for all columns: nothing may linger
    for w in range(width):
        alone = run(case, single, [own[:, w : w + 1] for own in xi], options)
        for block, column in zip(together, alone, strict=True):
            assert np.array_equal(block[:, w], column[:, 0])


def test_blas_would_fail_that_test() -> None:
    """Why the column products exist: a matrix times a vector and times a block differ in their last bits."""
    rng = np.random.default_rng(0)
    M, X = rng.standard_normal((6, 6)), rng.standard_normal((6, 64))
    assert any(not np.array_equal((M @ X)[:, w], M @ np.ascontiguousarray(X[:, w])) for w in range(64))


@pytest.mark.parametrize("shape", [(1, 1), (3, 1), (9, 1), (40, 1), (9, 2), (33, 7), (200, 3)])
def test_sums_are_sequential(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        terms = rng.standard_normal(shape) * 10.0 ** rng.integers(-8, 8, shape)
        expected = terms[0].copy()
        for row in terms[1:]:
            expected = expected + row
        out = np.full(shape[1], np.nan)
        sum_rows(terms, out)
        assert np.array_equal(out, expected)


def test_product_of_an_empty_matrix_is_zero() -> None:
    out = np.full(3, np.nan)
    ColumnProduct(np.zeros((3, 0)), np.zeros(0), out)()
    assert not out.any()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 7), st.booleans())
def test_finite_time_is_least_squares(seed: int, N: int, n: int, weighted: bool) -> None:
    """Exact for inconsistent data on any connected graph, in as many rounds as L has distinct nonzero eigenvalues."""
    case = Case(seed, N, n, weighted)
    xi = case.measured(5, consistent=False)
    answer, size = case.least_squares(xi), np.abs(case.inverse).max() * 10
    for x in run(case, case.fusions(case.finite, 5), xi, case.finite):
        assert np.abs(x - answer).max() < 1e-9 * max(1.0, size)
    assert fusion_rounds(case.finite) <= max(0, N - 1)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 5), st.booleans())
def test_admm_converges_to_least_squares(seed: int, N: int, n: int, normalised: bool) -> None:
    case = Case(seed, N, n)
    options = ADMM | {"nu": 3000}
    xi = case.measured(2, consistent=False)
    answer = case.least_squares(xi)
    assume(normalised or np.linalg.eigvalsh(case.H)[0] > 0.1)  # else it needs more iterations than a test should spend
    for x in run(case, case.fusions(options, 2, normalised), xi, options):
        assert np.abs(x - answer).max() < 1e-6 * max(1.0, np.abs(answer).max())


@settings(max_examples=20, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(2, 5), st.integers(1, 5))
def test_relaxed_survives_what_is_lost(seed: int, N: int, n: int) -> None:
    """Consistent data, 20 % of all messages lost: still exact, because nothing is summed up over the rounds."""
    case = Case(seed, N, n, weighted=False)
    options = RELAXED | {"rounds": 600}
    xi = case.measured(1, consistent=True)
    answer, rng = case.least_squares(xi), np.random.default_rng(seed)
    for x in run(case, case.fusions(options, 1), xi, options, lost=lambda: rng.random() < 0.2):
        assert np.abs(x - answer).max() < 1e-6 * max(1.0, np.abs(answer).max())


@pytest.mark.parametrize(
    ("name", "N", "rounds"),
    [
        ("ring", 4, 2),
        ("ring", 32, 16),
        ("path", 4, 3),
        ("path", 32, 31),
        ("star", 4, 2),
        ("star", 32, 2),
        ("complete", 4, 1),
        ("complete", 32, 1),
    ],
)
def test_finite_time_average_takes_the_diameter(name: str, N: int, rounds: int) -> None:
    """Rings, paths, stars, complete graphs up to 32 nodes: exact to 1e-13 thanks to Leja order."""
    W = np.zeros((N, N))
    if name == "complete":
        W = np.ones((N, N)) - np.eye(N)
    elif name == "star":
        W[0, 1:] = W[1:, 0] = 1
    else:
        for i in range(N - (name == "path")):
            W[i, (i + 1) % N] = W[(i + 1) % N, i] = 1
    values = spectrum(np.diag(W.sum(axis=1)) - W)
    assert len(values) == rounds
    start = np.random.default_rng(0).standard_normal((N, 21))
    hears = [{j: 1.0 for j in range(N) if W[i, j]} for i in range(N)]
    nodes = [FiniteTimeAverage(h, values, 21) for h in hears]
    for node, own in zip(nodes, start, strict=True):
        node.state[:] = own
    for r in range(rounds):
        sent = [node.message(r).copy() for node in nodes]
        for node, h in zip(nodes, hears, strict=True):
            node.exchange(r, {j: sent[j] for j in h})
    assert max(np.abs(node.state - start.mean(axis=0)).max() for node in nodes) < 1e-13
