"""``consensus: schur`` and ``robust``: what they find holds by the eigenvalues of independently stacked matrices."""

from __future__ import annotations

import numpy as np
import pytest

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.contingency import contingency
from duio_mesh.synthesis.pencil import Pencil
from duio_mesh.synthesis.spectral import radius_and_gradient
from tests.conftest import TOPOLOGIES


def designed(name, consensus, edges):
    overrides = {"observer.consensus": consensus} | ({"graph.edges": edges} if edges is not None else {})
    return synthesise(load_scenario(TOPOLOGIES / f"{name}.yaml", **overrides))


def star(hub):
    return [[hub, i] for i in range(1, 6) if i != hub]


@pytest.mark.parametrize(("hub", "known"), [(1, 0.9759), (2, 0.9751), (3, 0.9752), (4, 0.9759), (5, 0.9578)])
def test_schur_stabilises_every_star_of_example_61(hub, known):
    """``known``: the least radius that Nelder and Mead's method found; the paper's inequality refuses all five."""
    design = designed("six_state_ring", "schur", star(hub))
    found, ids = design.certificate, list(design.nodes)
    assert found["spectral_radius_undetectable"] < known + 2e-4
    L = np.zeros((5, 5))
    for a, b in star(hub):
        L[[a - 1, b - 1], [b - 1, a - 1]], L[a - 1, a - 1], L[b - 1, b - 1] = (
            -1,
            L[a - 1, a - 1] + 1,
            L[b - 1, b - 1] + 1,
        )
    Phi = -np.vstack([design.nodes[i].matrices["G"] @ np.kron(L[k : k + 1], np.eye(6)) for k, i in enumerate(ids)])
    for k, i in enumerate(ids):
        Phi[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += design.nodes[i].matrices["N"]
    assert np.abs(np.linalg.eigvals(Phi)).max() == pytest.approx(found["spectral_radius"], abs=1e-6)
    assert found["spectral_radius"] < 1
    assert np.abs(np.linalg.matrix_power(Phi, 4000)).max() < 1e-6  # it contracts in the end, after growing
    assert found["norm_phi_u"] > 1
    assert found["rate_bound"] is None
    assert not any("beta_u" in name for name in found["conditions"])


def test_schur_is_repeatable_and_refuses_what_it_cannot_do():
    first, second = (designed("six_state_ring", "schur", star(5)).certificate["g"] for _ in range(2))
    assert first == second
    with pytest.raises(
        DesignError, match=r"consensus: schur found no stabilising gains for node 1, which hears nobody"
    ):
        designed("six_state_ring", "schur", [])


def test_the_refusal_of_the_inequality_names_schur():
    with pytest.raises(DesignError, match="try consensus: schur"):
        designed("six_state_ring", "norm", star(5))


def test_gradient_of_the_radius():
    rng = np.random.default_rng(0)
    U = [np.linalg.qr(rng.standard_normal((4, 4)))[0][:, :k] for k in (2, 1, 3)]
    pencil = Pencil(
        [rng.standard_normal((u.shape[1],) * 2) for u in U],
        U,
        np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]]),
        "norm",
    )
    for _ in range(5):
        g, h = rng.standard_normal(3), 1e-6
        slopes = [
            (radius_and_gradient(pencil, g + h * d)[0] - radius_and_gradient(pencil, g - h * d)[0]) / (2 * h)
            for d in np.eye(3)
        ]
        np.testing.assert_allclose(radius_and_gradient(pencil, g)[1], slopes, atol=1e-5)


def test_robust_holds_for_every_lost_edge_of_the_heat_ring():
    design = designed("ring", "robust", None)
    found = contingency(design)
    radii = [case["radius"] for case in found["cases"] if case["links"]]
    assert len(radii) == 4
    assert max(radii) < 1
    promised = np.sqrt(1 + design.certificate["beta_u"])
    assert max(*radii, found["nominal"]) <= promised + 1e-9  # it never claims more than eigenvalues confirm
    plain = contingency(designed("ring", "norm", None))
    assert promised < 0.93 + 2e-3
    assert all(case["reconstructs"] for case in plain["cases"])
    assert design.certificate["beta_u_lower_bound"] == pytest.approx(design.certificate["beta_u"], abs=1e-6)


def test_robust_names_the_edge_that_prevents_it():
    with pytest.raises(DesignError, match=r"impossible whatever the others ask: edge 1-2 lost \(beta_u = \+0\.069"):
        designed("six_state_ring", "robust", None)


def test_robust_on_islands():
    """Heat nodes can do it alone, so even an island of two survives the loss of its only edge."""
    found = contingency(designed("partitioned", "robust", None))
    assert found["survives"]
