"""Example 9 of seed 001: what reproduces, what does not, and the single entry that explains it."""

from __future__ import annotations

from pathlib import Path

import example9_print as printed
import numpy as np
import pytest

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def load(name="augmented_example9", **overrides):
    return load_scenario(TOPOLOGIES / f"{name}.yaml", **{k.replace("__", "."): v for k, v in overrides.items()})


def printed_gains(repaired=False):
    """The paper's gains as they would stand in a file."""
    F = printed.F(repaired)
    own = {"Q": printed.Q1, "R": printed.R1, "S": printed.S1}
    return [{"node": i, "F": F[i], "K": printed.K[i], **(own if i == 1 else {})} for i in (1, 2, 3)]


def radius(Phi):
    return np.abs(np.linalg.eigvals(Phi)).max()


def printed_phi(repaired):
    N = {i: np.array(printed.N[i], dtype=float) for i in printed.N}
    if repaired:
        N[2][1, 2] = 0.4
    none = {"Q": np.zeros((3, 0)), "R": np.zeros((0, 3)), "S": np.zeros((0, 0))}
    own = {"Q": printed.Q1, "R": printed.R1, "S": printed.S1}
    return printed.phi({i: {"N": N[i], "K": printed.K[i], **(own if i == 1 else none)} for i in N})


def test_H_M_D_are_the_printed_ones_and_N_L_follow_from_the_printed_F():
    scenario = load(observer__gains={"given": printed_gains()}, observer__accept_unstable=True)
    design = synthesise(scenario)
    for i, node in design.nodes.items():
        for name, expected in (("H", printed.H), ("M", printed.M), ("N", printed.N), ("L", printed.L)):
            np.testing.assert_allclose(node.matrices[name], expected[i], atol=1e-14, err_msg=f"{name}_{i}")
        ours, theirs = scenario.unknown(i), np.array(printed.D[i], dtype=float)
        assert np.linalg.matrix_rank(np.hstack([ours, theirs])) == 2 == np.linalg.matrix_rank(theirs)


def test_the_printed_gains_are_not_schur_and_are_refused():
    assert radius(printed_phi(repaired=False)) == pytest.approx(4.54, abs=0.005)
    with pytest.raises(DesignError, match=r"spectral radius of the whole error system is 4\.539"):
        synthesise(load(observer__gains={"given": printed_gains()}))
    design = synthesise(load(observer__gains={"given": printed_gains()}, observer__accept_unstable=True))
    assert design.certificate["spectral_radius"] == pytest.approx(4.54, abs=0.005)
    assert design.certificate["conditions"]["Phi is Schur"]["ok"] is False
    assert design.certificate["distance_to_instability"] == 0


def brasch_pearson(repaired):
    """Node 1's designed matrices from the printed K_2 and K_3."""
    F = printed.F(repaired)
    fixed = [{"node": i, "F": F[i], **({"K": printed.K[i]} if i > 1 else {})} for i in (1, 2, 3)]
    return synthesise(load(observer__gains={"brasch_pearson": {"channel": 1, "fixed": fixed}}))


def misses(design):
    own = design.nodes[1].matrices
    pairs = (("K", printed.K[1]), ("Q", printed.Q1), ("R", printed.R1), ("S", printed.S1))
    return [float(np.abs(own[name] - theirs).max()) for name, theirs in pairs]


def test_one_entry_of_N2_explains_the_printed_gains():
    """With N_2(2,3) = 0.4 the construction meets the print up to the rounding of K_2, K_3; with 1.4 not."""
    repaired = misses(brasch_pearson(repaired=True))
    assert repaired[0] < 0.04
    assert repaired[1] < 0.22
    assert repaired[2] == 0
    assert repaired[3] < 0.02
    literal = misses(brasch_pearson(repaired=False))
    assert literal[0] > 2
    assert literal[1] > 30
    assert literal[3] > 3


def test_two_decimals_of_K2_and_K3_move_the_designed_gains_by_more_than_the_misses():
    rng = np.random.default_rng(0)
    base = brasch_pearson(repaired=True).nodes[1].matrices
    moved = np.zeros(3)
    for _ in range(20):
        F = printed.F(repaired=True)
        fixed = [{"node": 1, "F": F[1]}]
        for i in (2, 3):
            fixed.append({"node": i, "F": F[i], "K": (printed.K[i] + rng.uniform(-0.005, 0.005, (3, 3))).tolist()})
        own = synthesise(load(observer__gains={"brasch_pearson": {"channel": 1, "fixed": fixed}})).nodes[1].matrices
        moved = np.maximum(moved, [np.abs(own[x] - base[x]).max() for x in "KQS"])
    assert (moved > [0.0326, 0.2087, 0.0161]).all()


def test_the_topology_file_is_the_papers_construction_and_deadbeat():
    design = synthesise(load("augmented_example9_deadbeat"))
    matrices = {i: node.matrices for i, node in design.nodes.items()}
    assert misses(design) == misses(brasch_pearson(repaired=True))
    Phi = printed.phi(matrices)
    power = np.linalg.matrix_power(Phi, 11)
    assert np.linalg.norm(power, 2) < 1e-8 * design.certificate["peak"]
    assert design.certificate["peak"] == pytest.approx(5.1e4, rel=0.02)
    assert design.certificate["steps_to_1e-3"] == 11
    assert design.certificate["distance_to_instability"] == pytest.approx(7.7e-6, rel=0.02)


def test_no_gains_with_two_decimals_work():
    design = synthesise(load("augmented_example9_deadbeat"))
    assert radius(printed_phi(repaired=True)) == pytest.approx(1.92, abs=0.01)
    for decimals, expected in ((2, 1.99), (3, 1.41), (4, 0.91)):
        rounded = {
            i: {name: np.round(M, decimals) for name, M in node.matrices.items()} for i, node in design.nodes.items()
        }
        assert radius(printed.phi(rounded)) == pytest.approx(expected, abs=0.01), decimals


def test_F_zero_leaves_a_common_eigenvector_and_pole_placement_says_so():
    """C_i P_i A = 0 at all nodes: F moves nothing, yet F = 0 leaves A^-1 E an eigenvector of every N_i at 0."""
    scenario = load("augmented_example9_deadbeat")
    zero = [{"node": i, "F": [[0, 0]] * 3, **({"K": printed.K[i]} if i > 1 else {})} for i in (1, 2, 3)]
    gains = {"brasch_pearson": {"channel": 1, "radius": 0.5, "tolerance": 0.01, "fixed": zero}}
    v = np.linalg.solve(scenario.plant.A, scenario.plant.E)
    for i, node in scenario.nodes.items():
        P = np.eye(3) - np.array(printed.H[i]) @ node.C
        np.testing.assert_allclose(P @ scenario.plant.A @ v, 0, atol=1e-14)
    with pytest.raises(DesignError, match="no compensator at one of the nodes 1, 2, 3"):
        synthesise(load("augmented_example9_deadbeat", observer__gains=gains))
