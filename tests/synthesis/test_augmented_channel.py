"""Compensators at one node: Brasch-Pearson pole placement and the full-order LQG."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.augmented_channel import brasch_pearson, lqg

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def load(name, **overrides):
    return load_scenario(
        TOPOLOGIES / f"augmented_{name}.yaml", **{k.replace("__", "."): v for k, v in overrides.items()}
    )


def path_like_plant(seed, blocks=3, m=2):
    """A chain of ``blocks`` blocks of m states, driven at the first, measured by its disagreement with the second."""
    rng = np.random.default_rng(seed)
    size = blocks * m
    A = np.zeros((size, size))
    for k in range(blocks):
        for j in (k - 1, k, k + 1):
            if 0 <= j < blocks:
                A[k * m : (k + 1) * m, j * m : (j + 1) * m] = rng.standard_normal((m, m))
    C = np.hstack([np.eye(m), -np.eye(m), np.zeros((m, size - 2 * m))])
    return A, np.eye(size)[:, :m], C


def closed_loop(A, B, C, K, Q, R, S):
    return np.block([[A + B @ K @ C, B @ Q], [R @ C, S]])


@pytest.mark.parametrize("radius", [0.0, 0.4, 0.8])
def test_brasch_pearson_places_the_characteristic_polynomial(radius):
    A, B, C = path_like_plant(seed=3)
    Phi = closed_loop(A, B, C, *brasch_pearson(radius)(A, B, C))
    M = len(Phi)
    assert len(A) + 2 == M
    wanted = np.zeros(M + 1)
    wanted[0], wanted[-1] = 1.0, -(radius**M)
    scale = np.abs(np.poly(A)).max() * np.linalg.norm(Phi, 2)
    np.testing.assert_allclose(np.poly(Phi), wanted, atol=1e-9 * scale)


def test_lqg_keeps_the_wanted_rate():
    A, B, C = path_like_plant(seed=5)
    for rate in (1.0, 0.6):
        K, Q, R, S = lqg(rate)(A, B, C)
        values = np.linalg.eigvals(closed_loop(A, B, C, K, Q, R, S))
        assert np.abs(values).max() < rate
        # separation: the spectrum is that of A + B Q and of A - R C, found here by an unrelated route
        np.testing.assert_allclose(
            np.sort_complex(np.poly(values)),
            np.sort_complex(np.poly(np.r_[np.linalg.eigvals(A + B @ Q), np.linalg.eigvals(A - R @ C)])),
            atol=1e-7,
        )
    assert signal.StateSpace(A, B, C, np.zeros((2, 2)), dt=1).A.shape == A.shape


@pytest.mark.parametrize(("name", "peak"), [("example9", 10), ("six_state", 2e3), ("heat_ring", 30)])
def test_lqg_is_schur_where_pole_placement_fails(name, peak):
    found = synthesise(load(name, observer__gains="lqg")).certificate
    assert found["spectral_radius"] < 1
    assert found["peak"] < peak
    beta = [node["beta"] for node in found["nodes"].values()]
    assert sorted(beta)[:-1] == [0] * (len(beta) - 1)
    n = {"example9": 3, "six_state": 6, "heat_ring": 9}[name]
    assert max(beta) == n * len(beta)


def test_brasch_pearson_with_random_gains_works_on_the_small_example_only():
    found = synthesise(load("example9", observer__gains={"brasch_pearson": {"radius": 0.5}})).certificate
    assert found["spectral_radius"] == pytest.approx(0.5, abs=0.05)
    for name in ("six_state", "heat_ring"):
        with pytest.raises(DesignError, match=r"brasch_pearson: the poles|no compensator"):
            synthesise(load(name, observer__gains={"brasch_pearson": {"tries": 2, "channel": 1}}))


def test_a_transient_or_a_spectrum_that_was_not_asked_for_is_refused():
    fixed = load("example9_deadbeat").options.gains.brasch_pearson.model_dump()["fixed"]
    with pytest.raises(
        DesignError, match=r"initial errors may grow by 5\.1e\+04 before they decay; accepted is peak: 1000"
    ):
        synthesise(load("example9", observer__gains={"brasch_pearson": {"channel": 1, "fixed": fixed, "peak": 1000}}))
    with pytest.raises(DesignError, match=r"circle of radius 0, the computed spectral radius is 0\.0"):
        synthesise(
            load("example9", observer__gains={"brasch_pearson": {"channel": 1, "fixed": fixed, "tolerance": 0.001}})
        )


@pytest.mark.parametrize("gains", ["lqg", "brasch_pearson"])
def test_every_strongly_connected_component_gets_its_own_channel(gains):
    # {2, 3} is a source; 1 listens to it; a second island cannot exist with three nodes that need each other
    design = synthesise(load("directed", observer__gains=gains))
    beta = {i: node["beta"] for i, node in design.certificate["nodes"].items()}
    assert (beta[2] == 0) != (beta[3] == 0)
    assert design.certificate["spectral_radius"] < 1
    islands = synthesise(load("directed", observer__gains=gains, graph={"edges": [[2, 3]]}))
    assert islands.certificate["nodes"][1]["beta"] == 0
    assert islands.certificate["spectral_radius"] < 1


@pytest.mark.parametrize(
    ("gains", "message"),
    [
        ({"lqg": {"channel": 9}}, "channel names node 9; the nodes are 1, 2, 3"),
        ({"lqg": {"fixed": [{"node": 7}]}}, r"fixed\.0 names node 7"),
        ({"lqg": {"fixed": [{"node": 1}, {"node": 1}]}}, "fixed names node 1 twice"),
        ({"lqg": {"fixed": [{"node": 1, "F": [[1, 2]]}]}}, r"fixed\.0\.F should be 3 x 2"),
        ({"given": [{"node": 1, "F": [[0, 0]] * 3, "K": [[0] * 3] * 3}]}, "no gains for node 2, 3"),
        (
            {"given": [{"node": i, "F": [[0, 0]] * 3, "K": [[0] * 2] * 3} for i in (1, 2, 3)]},
            r"given\.0\.K should be 3 x 3",
        ),
        (
            {"given": [{"node": i, "F": [[0, 0]] * 3, "K": [[0] * 3] * 3, "S": [[0.5]]} for i in (1, 2, 3)]},
            r"given\.0\.Q should be 3 x 1",
        ),
        (
            {"given": [{"node": i, "F": [[0, 0]] * 3, "K": [[0] * 3] * 3, "H": [[0, 0]] * 3} for i in (1, 2, 3)]},
            r"given: node 1: H violates \(13\)",
        ),
    ],
)
def test_what_the_file_gives_is_checked(gains, message):
    with pytest.raises(DesignError, match=message):
        synthesise(load("example9", observer__gains=gains))


def test_one_step_late_messages_need_the_h2_design():
    with pytest.raises(DesignError, match="designed by gains: h2 only"):
        synthesise(load("example9", observer__gains="lqg", observer__delay=1))
