"""The fusion's recursion in blocks against the whole matrix."""

from __future__ import annotations

import numpy as np
import pytest

from duio_mesh import load_scenario
from duio_mesh.synthesis.admm import island_of
from duio_mesh.synthesis.admm_local import local_estimates
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
