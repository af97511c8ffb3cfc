"""The certificate's figures: noise, transient and distance to instability against brute force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.scenario.model import Noise
from duio_mesh.synthesis.augmented_error import distance_to_instability, transient
from duio_mesh.synthesis.lyapunov import gramians
from duio_mesh.synthesis.noise import noise_covariance

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def schur_matrix(seed, size=8, radius=0.9):
    M = np.random.default_rng(seed).standard_normal((size, size))
    return M * radius / spectral_radius(M)


@pytest.mark.parametrize(
    ("name", "steps"), [("example9", 12_000), ("directed", 12_000), ("six_state", 15_000), ("heat_ring", 12_000)]
)
def test_predicted_rms_is_what_a_long_run_shows(name, steps):
    path = TOPOLOGIES / f"augmented_{name}.yaml"
    design = synthesise(load_scenario(path, **{"plant.noise": {"std": 1e-3}, "run.steps": steps}))
    trace = simulate(design)
    rms = np.sqrt(((trace.xhat - trace.x)[:, 500:] ** 2).mean(axis=(1, 2)))
    predicted = [design.certificate["nodes"][i]["predicted_rms"] for i in trace.node_ids]
    np.testing.assert_allclose(rms, predicted, rtol=0.03)


def test_only_white_noise_is_a_covariance():
    channel = np.array([[1.0, 2.0], [0.0, 3.0]])
    signals = (({"normal": {"mean": 5.0, "std": 0.5}}, {"sine": {"amplitude": 9.0, "period": 2.0, "phase": 0.0}}), ())
    np.testing.assert_allclose(noise_covariance(Noise(channel, signals)), 0.25 * np.outer(channel[:, 0], channel[:, 0]))
    assert noise_covariance(Noise(np.zeros((3, 0)), ())).shape == (3, 3)


@pytest.mark.parametrize("seed", range(4))
def test_distance_to_instability_is_attained_and_not_undercut(seed):
    Phi = schur_matrix(seed)
    distance = distance_to_instability(Phi)
    angles = np.linspace(0, np.pi, 20_001)
    fine = [np.linalg.svd(np.exp(1j * a) * np.eye(8) - Phi, compute_uv=False)[-1] for a in angles]
    assert distance == pytest.approx(min(fine), rel=1e-5)
    z = np.exp(1j * angles[int(np.argmin(fine))])
    U, s, Vh = np.linalg.svd(z * np.eye(8) - Phi)
    touched = np.linalg.eigvals(Phi + s[-1] * np.outer(U[:, -1], Vh[-1]))
    assert np.abs(touched - z).min() < 1e-6


def test_distance_to_instability_of_a_normal_matrix_is_one_minus_the_radius():
    assert distance_to_instability(np.diag([0.3, -0.8])) == pytest.approx(0.2, rel=1e-9)
    assert distance_to_instability(np.diag([0.3, 1.0])) == 0


def test_transient_of_matrices_with_known_powers():
    chain = np.diag([10.0, 10.0], k=1)
    assert transient(chain).peak == pytest.approx(100)
    assert transient(chain).steps == 3
    slow = transient(np.array([[0.9999]]))
    assert slow.peak == 1
    assert slow.steps is None
    assert transient(np.array([[1.0]])) == (np.inf, None)


def test_gramians_by_doubling_are_scipys():
    Phi = schur_matrix(1, radius=0.999)
    W, Q = np.diag(np.arange(1.0, 9.0)), np.eye(8)
    X, Y = gramians(Phi, W, Q)
    np.testing.assert_allclose(X, linalg.solve_discrete_lyapunov(Phi, W), rtol=1e-8)
    np.testing.assert_allclose(Y, linalg.solve_discrete_lyapunov(Phi.T, Q), rtol=1e-8)
    assert gramians(schur_matrix(1, radius=1.0 + 1e-9), W, Q) is None
