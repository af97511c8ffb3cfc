"""Unknown-input decoupling of one node (seed 000, (6)-(10))."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.uio import decouple, decouple_node


def random_pair(seed: int, n: int, p: int, r: int):
    rng = np.random.default_rng(seed)
    return rng, rng.standard_normal((p, n)), rng.standard_normal((n, r))


@given(st.integers(0, 10**6), st.integers(1, 8), st.data())
@settings(deadline=None, derandomize=True, max_examples=60)
def test_takes_the_unknown_inputs_out_and_nothing_else(seed, n, data):
    p = data.draw(st.integers(1, n))
    r = data.draw(st.integers(0, p))
    rng, C, B = random_pair(seed, n, p, r)
    mixed = np.hstack([B @ rng.standard_normal((r, 2)), np.zeros((n, 1)), B])  # dependent, zero, then the columns
    found = decouple(C, mixed)
    scale = 1e-13 * (1 + np.linalg.norm(found.E) * np.linalg.norm(C)) ** 2
    np.testing.assert_allclose(found.P @ B, 0, atol=10 * scale)
    np.testing.assert_allclose(found.P @ found.P, found.P, atol=scale)
    assert np.linalg.matrix_rank(found.P, tol=1e-8) == n - r  # ker P = im B: as much of the state as possible is left
    np.testing.assert_allclose(found.P, np.eye(n) + found.E @ C, atol=0)
    if r:  # (8)-(9) on the independent columns themselves
        CB = C @ B
        np.testing.assert_allclose(
            found.E, -B @ np.linalg.inv(CB.T @ CB) @ CB.T, rtol=1e-5, atol=1e-9 * np.linalg.norm(found.E)
        )


def test_margins_do_not_depend_on_units():
    _, C, B = random_pair(3, 6, 3, 2)
    plain = decouple(C, B).margins
    scaled = decouple(np.diag([1e-5, 1.0, 1e6]) @ C, B * [1e4, 1e-6]).margins
    for name in ("output_rank", "unknown_input_rank", "decoupling_rank"):
        assert scaled[name] == pytest.approx(plain[name], rel=1e-6)


def test_margin_shrinks_with_the_distance_from_rank_loss():
    C = np.eye(2, 3)
    margins = [decouple(C, np.array([[1.0, 1.0], [0.0, far], [1.0, 0.0]])).margins for far in (1.0, 1e-3, 1e-6)]
    values = [m["decoupling_rank"] for m in margins]
    assert values[0] > 0.1
    assert values[1] == pytest.approx(1e-3, rel=0.5)
    assert values[2] == pytest.approx(1e-6, rel=0.5)


@pytest.mark.parametrize("Bbar", [np.zeros((4, 0)), np.zeros((4, 3))])
def test_without_unknown_inputs_nothing_is_changed(Bbar):
    found = decouple(np.eye(2, 4), Bbar)
    assert not found.E.any()
    np.testing.assert_array_equal(found.P, np.eye(4))
    assert found.basis.shape == (4, 0)


@pytest.mark.parametrize("short", [1e-13, 1e-30, 1e-200])
def test_the_length_of_a_column_is_only_its_unit(short):
    B = np.array([[1.0, 1e-17], [0.0, 3e-17], [0.0, -2e-17]]) * [1.0, short]
    found = decouple(np.eye(2, 3), B)
    assert found.basis.shape == (3, 2)
    np.testing.assert_allclose(found.P @ (B / np.abs(B).max(axis=0)), 0, atol=1e-14)


def test_measurements_in_very_different_units_do_not_cost_digits():
    _, C, B = random_pair(4, 6, 2, 2)
    found, plain = decouple(np.diag([1e-9, 1e8]) @ C, B), decouple(C, B)
    np.testing.assert_allclose(found.P, plain.P, atol=1e-12 * np.linalg.norm(plain.P))


TWO = [[{"constant": {"value": 1.0}}]] * 2
LARGE = {"time": "discrete", "period": 1, "A": [[0.5, 0], [0, 0.5]], "E": [[1e-5, 0], [0, 1e8]], "x0": [1, 1]}
HIDING = {"A": [[0.5, 0, 0], [0, 0.5, 0], [0, 1e-5, 0.5]], "E": [[1e5, 1e5], [1e-5, 0], [0, 0]], "x0": [1, 1, 1]}
HYDRAULIC = {
    "time": "continuous",
    "A": [[0, 1, 0], [-400, -6, 2e-5], [0, -1e9, -2]],
    "B": [[0], [0], [1e12]],
    "inputs": ["flow"],
    "control": {"signals": {"flow": {"constant": {"value": 1e-6}}}},
    "E": [[0], [0.02], [0]],
    "disturbance": TWO[:1],
    "x0": [0, 0, 0],
}


def designed(folder, plant, C, observer, **timing):
    """The design of one node on its own."""
    return synthesise(load_scenario(written(folder, plant, C, observer, **timing)))


def written(folder, plant, C, observer, **timing):
    """Its topology file."""
    plant = plant if "disturbance" in plant else {"disturbance": TWO, **plant}
    nodes, run = {"1": {"C": C}}, {"steps": 10, "convergence": {"rms_below": 1}, **timing}
    document = {"name": "units", "plant": plant, "observer": observer, "nodes": nodes, "run": run}
    document["graph"] = {"edges": []}
    path = folder / "units.yaml"
    path.write_text(json.dumps(document).replace('"1":', "1:"), "utf-8")
    return path


DISCRETE = [{"method": "lmi"}, {"method": "augmented"}, {"method": "admm", "fusion": "finite_time"}]


@pytest.mark.parametrize("observer", DISCRETE)
def test_an_input_in_large_units_does_not_hide_the_others(tmp_path, observer):
    made = designed(tmp_path, LARGE, [[1, 0], [0, 1]], observer)
    assert made.certificate["spectral_radius"] == pytest.approx(0, abs=1e-12)


def test_an_input_that_cannot_be_told_from_another_is_refused(tmp_path):
    """In the file's units; ``synthesise`` goes on to even ones, in which it can."""
    words = r"node 1: it is not told disturbance 1.* state x2.*Choose units of the states"
    path = written(tmp_path, {**LARGE, **HIDING}, [[1, 0, 0], [0, 1, 0]], DISCRETE[0])
    with pytest.raises(DesignError, match=words):
        decouple_node(load_scenario(path), 1)


@pytest.mark.parametrize("observer", DISCRETE)
def test_two_inputs_are_told_apart_in_even_units(tmp_path, observer):
    made = designed(tmp_path, {**LARGE, **HIDING}, [[1, 0, 0], [0, 1, 0]], observer)
    assert made.certificate["state_units"][0] > 2**20 * made.certificate["state_units"][1]
    trace = simulate(made)
    np.testing.assert_allclose(trace.xhat[0, 5:, :2], trace.x[5:, :2], rtol=1e-9)
    np.testing.assert_allclose(trace.xhat[0, -1, 2], trace.x[-1, 2], atol=2 * 0.5**9)


def test_the_geometric_observer_keeps_a_force_beside_a_flow(tmp_path):
    made = designed(tmp_path, HYDRAULIC, np.eye(3).tolist(), {"method": "geometric"}, step=0.001)
    assert made.certificate["nodes"][1]["dim_W"] == 2


@pytest.mark.parametrize(
    ("observer", "rate", "timing", "why"),
    [
        ({"method": "admm", "fusion": "finite_time"}, 0.5, {}, "neither follow nor measure 2 direction"),
        ({"method": "geometric"}, -1.0, {"step": 0.01}, "cannot follow the state alone"),
    ],
)
def test_a_state_that_the_input_reaches_is_not_lost_beside_large_entries(tmp_path, observer, rate, timing, why):
    """x2 follows the driven x1, but beside the entry 1e9 the recursion for W* takes that for rounding.

    In even units it does not, and says what is really in the way: neither x1 nor x2 is measured.
    """
    A = rate * np.eye(4)
    A[1, 0], A[2, 3] = 1.0, 1e9
    plant = {**LARGE, "A": A.tolist(), "E": np.eye(4, 1).tolist(), "disturbance": TWO[:1], "x0": [1, 1, 1, 1e-9]}
    if timing:
        plant["time"] = "continuous"
        del plant["period"]
    words = rf"node 1: the inputs .* reach state x2.*Choose units of the states.*unit of its own: .*{why}"
    with pytest.raises(DesignError, match=words):
        designed(tmp_path, plant, np.eye(4)[2:].tolist(), observer, **timing)


def test_says_who_cannot_be_decoupled_from_what():
    C, B = np.array([[1.0, 0.0, 0.0]]), np.eye(3)[:, :2]
    with pytest.raises(DesignError, match=r"node 7: Assumption 2 fails.*= 1, but rank\(B_iw\) = 2.*valve, leak") as e:
        decouple(C, B, "node 7", ["valve", "leak"])
    assert "More unknown inputs than measurements (1)" in str(e.value)
    with pytest.raises(DesignError, match=r"= 0, but rank\(B_iw\) = 1.*\[0\]"):
        decouple(np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), np.eye(3)[:, :1])
