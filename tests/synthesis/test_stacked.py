"""Errors kept in blocks, and Arnoldi's method, against the whole matrices."""

from __future__ import annotations

import contextlib
import io

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import load_scenario
from duio_mesh.generate import command
from duio_mesh.synthesis import synthesise
from duio_mesh.synthesis.sampled import Coupled
from duio_mesh.synthesis.stacked import Stacked


def network(seed=0, m=5, n=3):
    rng = np.random.default_rng(seed)
    sizes = rng.integers(2, 5, m)
    nodes = [
        Coupled(
            0.3 * rng.standard_normal((k, k)),
            rng.standard_normal((k, 2)),
            0.2 * rng.standard_normal((2, n)),
            rng.standard_normal((n, k)),
        )
        for k in sizes
    ]
    W = rng.random((m, m)) * (rng.random((m, m)) < 0.6)
    np.fill_diagonal(W, 0)
    return nodes, np.diag(W.sum(axis=1)) - W


def whole(nodes, L):
    """Phi, written with Kronecker products."""
    n = len(nodes[0].X)
    push = linalg.block_diag(*[node.K @ node.R for node in nodes])
    return linalg.block_diag(*[node.F for node in nodes]) - push @ np.kron(L, np.eye(n)) @ linalg.block_diag(
        *[node.X for node in nodes]
    )


def test_products_and_variances():
    nodes, L = network()
    Phi = whole(nodes, L)
    nodes = [node._replace(F=node.F * 0.5, K=node.K * 0.5) for node in nodes]
    Phi, errors = whole(nodes, L), Stacked(nodes, L)
    assert np.abs(np.linalg.eigvals(Phi)).max() < 0.99
    S = np.random.default_rng(1).standard_normal((errors.size, 4))
    np.testing.assert_allclose(errors.times(S), Phi @ S, atol=1e-12)
    np.testing.assert_allclose(errors.dense(), Phi, atol=1e-12)
    exact = np.diag(linalg.solve_discrete_lyapunov(Phi, S @ S.T))
    np.testing.assert_allclose(errors.variances(S), exact, rtol=1e-4)


def test_variances_that_never_settle_are_not_invented(monkeypatch):
    monkeypatch.setattr("duio_mesh.synthesis.stacked.LONGEST", 200)
    still = [Coupled(np.eye(2), np.zeros((2, 1)), np.zeros((1, 2)), np.eye(2))]
    assert Stacked(still, np.zeros((1, 1))).variances(np.ones((2, 1))) is None


@pytest.mark.parametrize("graph", ["grid", "ring"])
def test_a_large_certificate_says_what_all_eigenvalues_say(graph, tmp_path, monkeypatch):
    """36 rooms, 4 nodes: once with all eigenvalues, once with products only."""
    out = tmp_path / "heat.yaml"
    with contextlib.redirect_stdout(io.StringIO()):
        command.main(["heat", "--rooms", "6x6", "--nodes", "4", "--graph", graph, "--out", str(out)])
    scenario = load_scenario(out)
    dense = synthesise(scenario, lambda _: None)
    said = []
    monkeypatch.setattr("duio_mesh.synthesis.stacked.DENSE", 0)
    monkeypatch.setattr("duio_mesh.synthesis.lmi_network.DENSE", 0)
    blocks = synthesise(scenario, said.append)
    assert any("Arnoldi" in part for part in said)
    exact, found = dense.certificate, blocks.certificate
    L, n = scenario.graph.laplacian(), 36
    Phi = linalg.block_diag(*[spec.matrices["N"] for spec in dense.nodes.values()])
    Phi -= linalg.block_diag(*[spec.matrices["G"] for spec in dense.nodes.values()]) @ np.kron(L, np.eye(n))
    assert exact["spectral_radius"] == pytest.approx(np.abs(np.linalg.eigvals(Phi)).max(), abs=1e-9)
    for key in ("spectral_radius", "spectral_radius_undetectable", "spectral_radius_at_most", "beta_u"):
        assert found[key] == pytest.approx(exact[key], abs=1e-8)
    assert found["spectral_radius"] <= found["spectral_radius_at_most"] + 1e-8 < 1
    for i in dense.nodes:
        assert found["nodes"][i]["predicted_rms"] == pytest.approx(exact["nodes"][i]["predicted_rms"], rel=1e-4)
