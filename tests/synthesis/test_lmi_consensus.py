"""Coupling gains against the literal semidefinite programs and the paper's numbers."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from scipy import linalg

from duio_mesh.errors import DesignError
from duio_mesh.synthesis import barrier
from duio_mesh.synthesis.consensus import Undetectable, couple
from duio_mesh.synthesis.pencil import Pencil


def random_network(seed, m=4, n=4, directed=False):
    rng = np.random.default_rng(seed)
    W = rng.uniform(0.2, 3.0, (m, m)) * (rng.random((m, m)) < 0.7)
    np.fill_diagonal(W, 0)
    if not directed:
        W = np.triu(W) + np.triu(W).T
    A = rng.standard_normal((n, n))
    A *= 1.05 / np.linalg.norm(A, 2)
    parts = []
    for _ in range(m):
        U = np.linalg.qr(rng.standard_normal((n, n)))[0][:, : rng.integers(1, n)]
        parts.append(Undetectable(U.T @ A @ U, U))
    return parts, np.diag(W.sum(axis=1)) - W


def literal(parts, laplacian, criterion):
    """(38)-(39), or the least norm of A_u - Theta(g), with Theta of (42) written as it is printed."""
    import cvxpy as cp

    n, m = parts[0].U.shape[0], len(parts)
    U, Au = linalg.block_diag(*[p.U for p in parts]), linalg.block_diag(*[p.A for p in parts])
    g, beta, I = cp.Variable(m), cp.Variable(), np.eye(len(Au))
    Theta = sum(g[i] * (U.T @ np.kron(np.diag(np.eye(m)[i]) @ laplacian, np.eye(n)) @ U) for i in range(m))
    if criterion == "norm":
        problem = cp.Problem(cp.Minimize(cp.sigma_max(Au - Theta)))
        problem.solve(solver="CLARABEL")
        return g.value, problem.value**2 - 1
    M11 = Au.T @ Au - Au.T @ Theta - (Au.T @ Theta).T - I
    M = cp.bmat([[M11, Theta.T], [Theta, -I]])
    cp.Problem(cp.Minimize(beta), [beta * np.eye(2 * len(Au)) - (M + M.T) / 2 >> 0]).solve(solver="CLARABEL")
    return g.value, float(beta.value)


@pytest.mark.parametrize("criterion", ["paper", "norm"])
@pytest.mark.parametrize(("seed", "directed"), [(0, False), (1, True), (2, False)])
def test_is_the_optimum_of_the_semidefinite_program(seed, directed, criterion):
    parts, laplacian = random_network(seed, directed=directed)
    found = couple(parts, laplacian, criterion)
    _, beta = literal(parts, laplacian, criterion)
    assert found.beta == pytest.approx(beta, abs=1e-6)
    assert found.lower <= found.beta <= found.lower + 1e-6


def test_the_certificate_is_a_true_bound_and_phi_is_30():
    parts, laplacian = random_network(3, directed=True)
    found = couple(parts, laplacian, "norm")
    U, Au = linalg.block_diag(*[p.U for p in parts]), linalg.block_diag(*[p.A for p in parts])

    def phi(g):
        return Au - U.T @ np.kron(np.diag(g) @ laplacian, np.eye(4)) @ U

    np.testing.assert_allclose(found.phi, phi(found.g), atol=1e-12)
    assert found.norm == pytest.approx(np.linalg.norm(found.phi, 2))
    assert found.beta == pytest.approx(found.norm**2 - 1, abs=1e-8)
    rng = np.random.default_rng(0)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(50):
            g = found.g + size * rng.standard_normal(4)
            assert np.linalg.norm(phi(g), 2) ** 2 - 1 >= found.lower


def test_39_is_conservative_where_it_is_feasible():
    parts, laplacian = random_network(0)
    shrunk = [Undetectable(0.8 * p.A, p.U) for p in parts]
    paper, norm = couple(shrunk, laplacian, "paper"), couple(shrunk, laplacian, "norm")
    assert norm.beta < paper.beta < 0
    assert paper.norm**2 - 1 <= paper.beta


def test_a_lone_node_and_nodes_without_an_undetectable_part():
    U = np.eye(3)[:, :2]
    alone = couple([Undetectable(np.diag([0.5, -0.8]), U)], np.zeros((1, 1)), "norm")
    assert alone.g == 0
    assert alone.beta == pytest.approx(0.8**2 - 1)
    nothing = Undetectable(np.zeros((0, 0)), np.zeros((3, 0)))
    edge = np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = couple([nothing, nothing], edge, "paper")
    assert (both.beta, both.norm, both.phi.shape) == (-1.0, 0.0, (0, 0))
    one = couple([Undetectable(np.diag([1.2, 1.1]), U), nothing], edge, "norm")
    assert one.g[1] == 0
    assert one.g[0] == pytest.approx(1.15)  # |1.2 - g| = |1.1 - g|
    assert one.beta == pytest.approx(0.05**2 - 1)


@pytest.mark.parametrize("a", [0.3, 1.0, 2.0])
def test_39_in_closed_form(a):
    """One mode a: gamma = a^2 - 2 a g + g^2 / gamma is least, a^2 / (1 + a^2), at g = a gamma."""
    one, nothing = Undetectable(np.array([[a]]), np.eye(2)[:, :1]), Undetectable(np.zeros((0, 0)), np.zeros((2, 0)))
    found = couple([one, nothing], np.array([[1.0, -1.0], [-1.0, 1.0]]), "paper")
    assert found.g[0] == pytest.approx(a**3 / (1 + a**2), abs=1e-5)
    assert found.beta == pytest.approx(-1 / (1 + a**2), abs=1e-7)
    assert found.lower <= -1 / (1 + a**2) + 1e-12


def stacked(parts, laplacian, criterion, g, t):
    """S of (38) or (49) as a Schur complement, with Theta of (42) as it is printed."""
    U, A, n = linalg.block_diag(*[p.U for p in parts]), linalg.block_diag(*[p.A for p in parts]), len(parts[0].U)
    Theta = U.T @ np.kron(np.diag(g) @ laplacian, np.eye(n)) @ U
    cross = A.T @ Theta
    return t * np.eye(len(A)) - A.T @ A + cross + cross.T - Theta.T @ Theta / (t if criterion == "paper" else 1)


def pencil_and_gains(criterion, directed=True, m=4, n=4):
    parts, laplacian = random_network(4, m, n, directed=directed)
    g = 0.1 * np.random.default_rng(0).standard_normal(m)
    return parts, laplacian, Pencil([p.A for p in parts], [p.U for p in parts], laplacian, criterion), g


@pytest.mark.parametrize("criterion", ["paper", "norm"])
def test_derivatives_of_the_barrier(criterion):
    """Against differences of log det of X'SX, written out in full."""
    parts, laplacian, pencil, g = pencil_and_gains(criterion)
    X = np.linalg.qr(np.random.default_rng(1).standard_normal((pencil.N, 5)))[0]
    z = np.append(g, 1.5 + pencil.leading(g, 1, np.ones(pencil.N))[0])

    def value(z):
        sign, found = np.linalg.slogdet(X.T @ stacked(parts, laplacian, criterion, z[:-1], z[-1]) @ X)
        assert sign > 0
        return 7 * z[-1] - found

    problem = [pencil.reduced(X)]
    gradient, hessian, bound = barrier._derivatives(problem, barrier._at(problem, z), 7.0)
    assert bound < z[-1]
    h, I = 1e-4, np.eye(len(z))
    slopes = [(value(z + h * d) - value(z - h * d)) / (2 * h) for d in I]
    np.testing.assert_allclose(gradient, slopes, atol=1e-5 * np.abs(gradient).max())
    bends = [
        [
            (value(z + h * (a + b)) - value(z + h * (a - b)) - value(z - h * (a - b)) + value(z - h * (a + b)))
            / (4 * h * h)
            for b in I
        ]
        for a in I
    ]
    np.testing.assert_allclose(hessian, bends, atol=1e-4 * np.abs(hessian).max())


@pytest.mark.parametrize("dense", [0, 1000])
@pytest.mark.parametrize("criterion", ["paper", "norm"])
def test_value_and_proof_against_the_whole_matrix(criterion, dense, monkeypatch):
    """By Lanczos' method and by all eigenvectors; the block Cholesky factor exists just above, not just below."""
    monkeypatch.setattr("duio_mesh.synthesis.pencil.DENSE", dense)
    parts, laplacian, pencil, g = pencil_and_gains(criterion, m=9, n=7)
    t, x = pencil.leading(g, 3, np.ones(pencil.N))
    S = stacked(parts, laplacian, criterion, g, t)
    assert np.linalg.eigvalsh(S)[0] == pytest.approx(0, abs=1e-9)
    assert np.linalg.eigvalsh(x.T @ S @ x)[0] == pytest.approx(0, abs=1e-9)
    assert pencil.holds(g, t + 1e-8)
    assert not pencil.holds(g, t - 1e-8)


def test_scales_far_apart():
    """Weights of 1000 and 0.001, as a user's graph may have them: only g changes, by the inverse factor."""
    parts, laplacian = random_network(2)
    base = couple(parts, laplacian, "norm")
    for factor in (1e3, 1e-3):
        scaled = couple(parts, factor * laplacian, "norm")
        assert scaled.beta == pytest.approx(base.beta, abs=1e-6)
        np.testing.assert_allclose(scaled.g * factor, base.g, rtol=1e-3)


def test_a_badly_followed_path_is_right_or_refused(monkeypatch):
    """With absurd barrier steps; and a value that the last Cholesky factor does not confirm is refused."""
    parts, laplacian = random_network(0)
    right = couple(parts, laplacian, "paper").beta
    for factor in (1e3, 1e5, 1e7, 1e9):
        monkeypatch.setattr("duio_mesh.synthesis.barrier.GROWTH", factor)
        with contextlib.suppress(DesignError):
            assert couple(parts, laplacian, "paper").beta == pytest.approx(right, abs=1e-6)
    leading = Pencil.leading
    monkeypatch.setattr(Pencil, "leading", lambda *args: (lambda t, x: (t - 1e-6, x))(*leading(*args)))
    with pytest.raises(DesignError, match="Cholesky factor does not confirm"):
        couple(parts, laplacian, "paper")
