"""The fusion's recursion in blocks against the whole matrix."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from duio_mesh import load_scenario
from duio_mesh.synthesis.admm import island_of
from duio_mesh.synthesis.admm_local import local_estimates, noise_gain
from duio_mesh.synthesis.admm_rates import admm_matrix, admm_product, fusion_radius
from tests.conftest import TOPOLOGIES


@pytest.mark.parametrize("fusion", ["admm", "relaxed"])
def test_radius_from_products_is_that_of_all_eigenvalues(fusion, monkeypatch):
    scenario = load_scenario(TOPOLOGIES / f"{fusion}_ring.yaml")
    options = scenario.options
    island = island_of(scenario, tuple(scenario.nodes), local_estimates(scenario, options))
    steps = island.step_sizes(options)
    exact = fusion_radius(island, options)
    if fusion == "admm":
        M = admm_matrix(island, options, steps)
        np.testing.assert_allclose(admm_product(island, options, steps)(np.eye(len(M))), M, atol=1e-10)
        assert exact == pytest.approx(np.abs(np.linalg.eigvals(M)).max(), rel=1e-12)
    monkeypatch.setattr("duio_mesh.synthesis.stacked.DENSE", 0)
    monkeypatch.setattr("duio_mesh.synthesis.stacked.BASIS", 20)
    assert fusion_radius(island, options) == pytest.approx(exact, abs=1e-7)


def local(Phi, drive):
    """What ``noise_gain`` reads of a node that follows all its states: e+ = Phi e - drive v."""
    return SimpleNamespace(filter=SimpleNamespace(Abar=Phi, P=np.eye(len(Phi)), L=drive))


def test_a_direction_that_no_noise_enters_has_no_negative_variance():
    """The variance of m'c v, m orthogonal to c, is -0.03 in floating point: it was NaN, and a warning."""
    rng = np.random.default_rng(0)
    c = 1e8 * rng.standard_normal((3, 1))
    maps = np.zeros((1, 1, 4))
    maps[0, 0, :3] = np.linalg.svd(c.T)[2][1]
    assert noise_gain([local(np.zeros((3, 3)), c)], maps) < 2


def test_noise_gain_does_not_depend_on_units_of_the_states():
    """scipy solves the Lyapunov equation as one linear system, which warns of a singular matrix in these units."""
    units, drive = np.array([1e9, 1.0]), np.array([[0.3], [1.0]])
    Phi = np.array([[0.5, 1.0], [0.0, 0.5]])
    maps = np.eye(2, 3)[None]
    plain = noise_gain([local(Phi, drive)], maps)
    scaled = noise_gain([local(Phi * np.outer(units, 1 / units), units[:, None] * drive)], maps)
    np.testing.assert_allclose(scaled, units * plain, rtol=1e-12)
