"""Local gains of the LMI observer against the semidefinite program (34), Lyapunov equations and asked-for spectra."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.geometry import complement, image
from duio_mesh.synthesis.local_gain import Subsystem, h2_gain, hinf_gain, placed_gain
from duio_mesh.synthesis.uio import decouple

SIX = Path(__file__).parents[2] / "topologies" / "six_state_ring.yaml"


def random_subsystem(seed, n=4, p=2, q=1, radius=1.2):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C, B = rng.standard_normal((p, n)), rng.standard_normal((n, q))
    uio = decouple(C, B)
    return Subsystem(uio.P @ A, C, uio.E), complement(image(C @ uio.basis))


def literal_34(system):
    """beta of (34), all four block rows as printed, by cvxpy and Clarabel."""
    import cvxpy as cp

    A, C, F = system
    d, p = F.shape
    P, Y, beta = cp.Variable((d, d), symmetric=True), cp.Variable((d, p)), cp.Variable()
    first = cp.hstack([P, P @ A - Y @ C, -Y, -P @ F, np.zeros((d, d))])
    second = cp.hstack([(P @ A - Y @ C).T, P, np.zeros((d, 2 * p)), np.eye(d)])
    third = cp.hstack([cp.hstack([-Y, -P @ F]).T, np.zeros((2 * p, d)), beta * np.eye(2 * p), np.zeros((2 * p, d))])
    fourth = cp.hstack([np.zeros((d, d)), np.eye(d), np.zeros((d, 2 * p)), beta * np.eye(d)])
    M = cp.vstack([first, second, third, fourth])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate"
        cp.Problem(cp.Minimize(beta), [(M + M.T) / 2 >> 0]).solve(solver="CLARABEL")
    return float(beta.value)


def fine_sweep(system, K):
    """The largest singular value of [v(k); v(k+1)] -> e on 20001 frequencies."""
    A, C, F = system
    closed, inputs = A - K @ C, np.hstack([K, -F])
    z = np.exp(1j * np.linspace(0, np.pi, 20001))[:, None, None]
    values = np.linalg.solve(z * np.eye(len(A)) - closed, np.broadcast_to(inputs, (20001, *inputs.shape)))
    return np.linalg.norm(values, 2, axis=(1, 2)).max()


def error_power(system, K, V):
    """Stationary trace cov e of (26) from the recursion of [e(k); v(k)]."""
    A, C, F = system
    d, p = F.shape
    M = np.block([[A - K @ C, K], [np.zeros((p, d + p))]])
    B = np.vstack([-F, np.eye(p)])
    assert np.abs(np.linalg.eigvals(M)).max() < 1
    return np.trace(linalg.solve_discrete_lyapunov(M, B @ V @ B.T)[:d, :d])


@pytest.mark.parametrize(("seed", "radius", "q"), [(0, 1.2, 1), (1, 0.9, 1), (2, 1.5, 1), (3, 1.1, 0)])
def test_hinf_is_the_optimum_of_34(seed, radius, q):
    system, _ = random_subsystem(seed, radius=radius, q=q)
    K, beta = hinf_gain(system, "node 1")
    assert beta == pytest.approx(literal_34(system), rel=1e-3)
    assert fine_sweep(system, K) == pytest.approx(beta, rel=1e-4)
    assert np.abs(np.linalg.eigvals(system.A - K @ system.C)).max() < 1


def test_beta_id_of_example_61():
    """Optima of (34) on the printed matrices, per node; at nodes 1 and 3 K is inert and D'E has norm 1."""
    certificate = synthesise(load_scenario(SIX)).certificate
    np.testing.assert_allclose(certificate["beta_id"], [1.0, 224.165, 1.0, 4.2553, 22.134], rtol=1e-4)
    assert [node["K_is_inert"] for node in certificate["nodes"].values()] == [True, False, True, False, False]
    assert certificate["spectral_radius_detectable"] == pytest.approx(0.9677, abs=1e-4)


def test_hinf_needs_no_gain_for_a_stable_part_without_unknown_inputs():
    system = Subsystem(np.diag([0.5, -0.9]), np.eye(1, 2), np.zeros((2, 1)))
    K, beta = hinf_gain(system, "node 1")
    assert not K.any()
    assert beta == 0


def test_hinf_refuses_an_unseen_unstable_mode():
    with pytest.raises(DesignError, match=r"node 4: no stabilising gain.*1\.1"):
        hinf_gain(Subsystem(np.diag([0.5, 1.1]), np.eye(1, 2), np.zeros((2, 1))), "node 4")


@pytest.mark.parametrize("q", [0, 1])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_h2_is_stationary_and_better_than_other_gains(seed, q):
    system, seen = random_subsystem(seed, q=q)
    rng = np.random.default_rng(seed + 100)
    V = np.diag([1.0, 0.3])
    K = h2_gain(system, seen, V, "node 1")
    best = error_power(system, K, V)
    for _ in range(20):  # K may move along all measurements that carry an innovation
        direction = rng.standard_normal((len(K), seen.shape[1])) @ seen.T
        for size in (1e-3, -1e-3, 0.05, -0.05):
            other = K + size * direction
            if np.abs(np.linalg.eigvals(system.A - other @ system.C)).max() < 1:
                assert error_power(system, other, V) > best * (1 - 1e-6)
    assert error_power(system, hinf_gain(system, "node 1")[0], V) >= best * (1 - 1e-6)


def test_h2_depends_on_the_shape_of_the_noise_only():
    system, seen = random_subsystem(4)
    V = np.diag([2.0, 1.0])
    np.testing.assert_allclose(h2_gain(system, seen, V, ""), h2_gain(system, seen, 1e-6 * V, ""), rtol=1e-6)
    np.testing.assert_allclose(h2_gain(system, seen, 0 * V, ""), h2_gain(system, seen, np.eye(2), ""), rtol=1e-6)


def test_poles_go_where_they_are_asked_and_unobservable_modes_stay():
    rng = np.random.default_rng(0)
    T = np.linalg.qr(rng.standard_normal((5, 5)))[0]
    A = linalg.block_diag(np.array([[1.2, 1.0, 0.0], [0.0, 0.9, 1.0], [0.1, 0.0, 1.1]]), np.diag([0.35, -0.45]))
    C = np.hstack([rng.standard_normal((2, 3)), np.zeros((2, 2))])
    system = Subsystem(T @ A @ T.T, C @ T.T, np.zeros((5, 2)))
    K = placed_gain(system, 0.2, 0.6, "node 1")
    got = np.sort(np.linalg.eigvals(system.A - K @ system.C).real)
    np.testing.assert_allclose(got, np.sort([0.2, 0.4, 0.6, 0.35, -0.45]), atol=1e-6)


def test_poles_that_double_precision_cannot_place_are_refused():
    n = 14
    chain = np.eye(n, k=1) + np.diag(np.linspace(1.0, 1.3, n))
    with pytest.raises(DesignError, match=r"node 2: poles 0 to 0\.1 are too hard to place"):
        placed_gain(Subsystem(chain, np.eye(1, n), np.zeros((n, 1))), 0.0, 0.1, "node 2")


def test_an_eigenvalue_that_rounds_below_one_gets_a_gain():
    system = Subsystem(np.array([[0.7, 0.3], [0.3, 0.7]]), np.eye(1, 2), np.zeros((2, 1)))
    assert np.abs(np.linalg.eigvals(system.A)).max() == pytest.approx(1, abs=1e-15)
    K, _ = hinf_gain(system, "node 1")
    assert np.abs(np.linalg.eigvals(system.A - K @ system.C)).max() < 0.95
