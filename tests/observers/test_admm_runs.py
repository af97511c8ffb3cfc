"""The observer through topology files: local estimate, set-up by the nodes, islands, loss, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from duio_mesh import Design, DesignError, RunError, ScenarioError, Trace, simulate, synthesise
from duio_mesh.dynamics import Plant
from duio_mesh.observers import make_observer
from duio_mesh.scenario import load_scenario
from duio_mesh.synthesis import options_of

TOPOLOGIES = Path(__file__).parents[2] / "topologies"
START = [1, 2, 3, -1, -2, -3]


def designed(name: str, **overrides: object) -> Design:
    """Overrides with two underscores for a dot: ``observer__nu=50``. Node ids stay numbers, unlike in JSON."""
    texts = []
    for key, value in overrides.items():
        written = re.sub(r'"([0-9]+)":', r"\1:", json.dumps(value))
        texts.append(f"{key.replace('__', '.')}={written}")
    return synthesise(load_scenario(TOPOLOGIES / name, texts, options_of=options_of))


def run_lossy(design: Design, lost: Callable[[int, int, int], bool]) -> np.ndarray:
    """Errors (N, K, n) when ``lost(r, source, target)`` says which messages do not arrive."""
    plant = Plant(design.plant)
    observers = {i: make_observer(spec) for i, spec in design.nodes.items()}
    errors = []
    for _ in range(design.plant.steps):
        data = plant.sample()
        for i, o in observers.items():
            o.sample(data[i][: design.nodes[i].p], data[i][design.nodes[i].p :])
        for r in range(max(o.rounds for o in observers.values())):
            sent = {i: o.message(r).copy() for i, o in observers.items()}
            for i, o in observers.items():
                o.exchange(r, {j: sent[j] for j in design.nodes[i].hears if not lost(r, j, i)})
        errors.append([o.estimate().state - plant.x for o in observers.values()])
        plant.advance()
    return np.array(errors).transpose(1, 0, 2)


def worst(trace: Trace, since: int = 0) -> float:
    return float(np.abs(trace.xhat - trace.x)[:, since:].max())


def algorithm_1(design: Design, steps: int) -> np.ndarray:
    """Every node's estimates (N, K, n): the paper's lines in the paper's order, in z = S x, dictionaries and loops."""
    spec = design.nodes
    options = spec[1].options
    H = sum(s.matrices["T"].T @ s.matrices["T"] for s in spec.values())
    S = np.linalg.cholesky(H).T
    T = {i: s.matrices["T"] @ np.linalg.inv(S) for i, s in spec.items()}
    gamma, degree = options["gamma"], {i: sum(s.hears.values()) for i, s in spec.items()}
    alpha = {i: 1 / (np.linalg.norm(T[i].T @ T[i], 2) + gamma * degree[i]) for i in spec}
    plant, local = Plant(design.plant), {i: s.matrices["s0"] for i, s in spec.items()}
    found = []
    for _ in range(steps):
        data = plant.sample()
        xi = {i: np.concatenate([local[i], data[i][: s.p]]) for i, s in spec.items()}
        z, phi, psi = ({i: np.zeros(6) for i in spec} for _ in range(3))
        for _ in range(options["nu"]):
            z = {i: z[i] - alpha[i] * (T[i].T @ (T[i] @ z[i] - xi[i]) + phi[i] + psi[i]) for i in spec}
            for i, s in spec.items():
                phi[i] = gamma / 2 * sum(a * (z[i] - z[j]) for j, a in s.hears.items())
                psi[i] = psi[i] + phi[i]
        found.append([np.linalg.solve(S, z[i]) for i in spec])
        for i, s in spec.items():
            m, y, u = s.matrices, data[i][: s.p], data[i][s.p :]
            local[i] = m["Abar"] @ local[i] - m["PL"] @ y + m["PB"] @ u  # (5)
        plant.advance()
    return np.array(found).transpose(1, 0, 2)


@pytest.mark.parametrize("edges", [None, [[1, 2, 0.7], [2, 4, 1.3], [4, 3], [3, 1, 2.0]]])
def test_the_observer_is_algorithm_1_line_by_line(edges: list | None) -> None:
    """From a start that the local estimates do not know, with noise: nothing hides in a fixed point. Weighted too."""
    more = {"graph__edges": edges} if edges else {}
    design = designed(
        "admm_ring.yaml", plant__x0=START, plant__noise={"std": 0.01}, run__steps=40, observer__nu=25, **more
    )
    assert np.abs(simulate(design).xhat - algorithm_1(design, 40)).max() < 1e-9


def test_a_node_holds_only_its_own() -> None:
    """No other node's C, no Laplacian: own filter, own T, H^-1, scalars, weights of its neighbours."""
    design = designed("admm_ring.yaml")
    for i, spec in design.nodes.items():
        assert set(spec.matrices) == {"Abar", "PL", "PB", "T", "s0", "Hinv"}
        assert spec.matrices["T"].shape == ({1: 1, 2: 2, 3: 2, 4: 4}[i], 6)
        assert set(spec.options) == {"fusion", "setup", "gamma", "nu", "alpha_factor"}
    assert "Hinv" not in designed("admm_star.yaml").nodes[1].matrices
    assert "Hinv" not in designed("admm_plain.yaml").nodes[1].matrices


def test_local_error_obeys_its_recursion() -> None:
    """s_i - P_i x decays by Abar_i alone, whatever the unknown inputs do."""
    design = designed("admm_ring.yaml", plant__x0=START)
    for i, spec in design.nodes.items():
        m, plant = spec.matrices, Plant(design.plant)
        P = m["T"][: len(m["Abar"])]
        s, error = m["s0"], m["s0"] - P @ np.array(START, dtype=float)
        for _ in range(200):
            y, u = np.split(plant.sample()[i], [spec.p])
            s = m["Abar"] @ s - m["PL"] @ y + m["PB"] @ u
            error = m["Abar"] @ error
            plant.advance()
            assert np.abs(s - P @ plant.x - error).max(initial=0.0) < 1e-11


def test_start_of_the_local_estimate() -> None:
    """Zero is forgotten with 0.9885^k and amplified by up to 1/0.0034; the projection of a known start is exact."""
    common = {"plant__x0": START, "run__steps": 600}
    forgetting = simulate(designed("finite_time_ring.yaml", **common))
    error = np.abs(forgetting.xhat - forgetting.x).max(axis=(0, 2))
    assert error[[0, 100, 300, 599]] == pytest.approx([39, 12, 1.1, 0.035], rel=0.1)
    assert worst(simulate(designed("finite_time_ring.yaml", observer__initial="projection", **common))) < 1e-10
    # of a random start a node knows the mean, not the draw
    drawn = {"normal": {"mean": START, "std": 0.1}}
    known = designed("finite_time_ring.yaml", observer__initial="projection", plant__x0=drawn)
    P = known.nodes[2].matrices["T"][:1]
    assert known.nodes[2].matrices["s0"] == pytest.approx(P @ np.array(START, dtype=float))


@pytest.mark.parametrize("fusion", ["admm", "finite_time", "relaxed"])
def test_nodes_find_H_themselves(fusion: str) -> None:
    """Two more rounds in step 0, with 21 numbers; afterwards the same estimates to rounding."""
    common = {"observer__fusion": fusion, "run__steps": 20, "plant__x0": START}
    base = "finite_time_ring.yaml"
    design = designed(base, **common)
    observer = make_observer(design.nodes[1])
    observer.sample(np.zeros(1), np.zeros(1))
    usual = {"admm": 59, "finite_time": 2, "relaxed": 80}[fusion]
    assert observer.rounds == usual + 2
    assert observer.message(0).shape == (21,)
    other = simulate(designed(base, observer__setup="global", **common))
    assert np.abs(simulate(design).xhat - other.xhat).max() < 1e-10
    with pytest.raises(RunError, match=r"node 1: no message from node\(s\) \[3\] in round 0 of the set-up"):
        observer.exchange(0, {2: np.zeros(21)})


def test_each_island_on_its_own() -> None:
    """No node reconstructs alone; each island does, with its own H and its own rate, also from an unknown start."""
    design = designed("admm_partitioned.yaml", plant__x0=START)
    assert [n["reconstructs_alone"] for n in design.certificate["nodes"].values()] == [2, 1, 3, 3, 3]
    assert [part["nodes"] for part in design.certificate["islands"]] == [[1, 2, 3], [4, 5]]
    trace = simulate(design)
    assert worst(trace) > 0.1
    assert worst(trace, since=350) < 5e-6
    left, right = (design.nodes[i].matrices["Hinv"] for i in (1, 4))
    assert not np.allclose(left, right)
    exact = simulate(
        designed("admm_partitioned.yaml", observer={"method": "admm", "fusion": "finite_time", "stable_radius": 0.97})
    )
    assert worst(exact) < 1e-12


def test_islands_of_different_size_take_their_own_rounds() -> None:
    options = {"method": "admm", "fusion": "finite_time", "stable_radius": 0.97, "setup": "distributed"}
    design = designed("admm_partitioned.yaml", observer=options)
    assert [part["rounds"] for part in design.certificate["islands"]] == [2, 1]
    assert worst(simulate(design)) < 1e-12


@pytest.mark.parametrize("fusion", ["admm", "finite_time", "relaxed"])
def test_a_node_that_needs_nobody(fusion: str) -> None:
    """One node, no edges: the fusion solves its own least squares."""
    node = {1: {"C": np.eye(6).tolist(), "knows": ["ua"]}}
    observer = {"method": "admm", "fusion": fusion, "setup": "distributed", "initial": "projection"}
    design = designed("admm_ring.yaml", nodes=node, graph__edges=[], observer=observer, plant__x0=START, run__steps=5)
    assert worst(simulate(design)) < 1e-12


def test_poles_go_where_they_can_be_placed() -> None:
    """A node that sees everything and knows one input places all four eigenvalues that the others leave it."""
    node = {1: {"C": np.eye(6).tolist(), "knows": ["ua"]}}
    common = {"nodes": node, "graph__edges": []}
    design = designed("admm_ring.yaml", observer__poles=[0.1, -0.2, 0.3, 0.4, 0.5], **common)
    placed = design.certificate["nodes"][1]["local_eigenvalues"]
    assert sorted(v[0] for v in placed) == pytest.approx([-0.2, 0.1, 0.3, 0.4], abs=1e-6)
    with pytest.raises(DesignError, match=r"node 1: no local estimate.*4 poles can be placed on X/W but only 1"):
        designed("admm_ring.yaml", observer__poles=[0.1], **common)


def test_relaxed_fusion_survives_loss() -> None:
    """20 % of all messages on the ring never arrive, independently: below 1e-6 in every step all the same."""
    design = designed("relaxed_ring.yaml", run__steps=50)
    rng = np.random.default_rng(0)
    errors = run_lossy(design, lambda r, source, target: rng.random() < 0.2)
    assert np.abs(errors).max() < 1e-6


def test_relaxed_fusion_survives_a_silent_stretch_and_late_messages() -> None:
    """One direction of one edge is silent for the first 30 of 200 rounds; later everything arrives."""
    design = designed("relaxed_ring.yaml", run__steps=30, observer__rounds=200)
    errors = run_lossy(design, lambda r, source, target: (source, target) == (1, 2) and r < 30)
    assert np.abs(errors).max() < 1e-9


def test_admm_does_not_survive_one_lost_message() -> None:
    """A limit of (15), not of the code: the sum of all psi_i is no longer zero, and more rounds do not help."""
    design = designed("admm_ring.yaml", run__steps=60, observer__nu=400)
    assert np.abs(run_lossy(design, lambda *_: False)).max() < 1e-9
    errors = run_lossy(design, lambda r, source, target: (r, source, target) == (2, 1, 2))
    assert np.abs(errors[:, 30:]).max() > 1e-3


def test_rounds_can_be_watched() -> None:
    """The hook sees the iterate of every round: residual of its own equations, distance to its neighbours."""
    design = designed("admm_ring.yaml", run__steps=1)
    plant, observers = Plant(design.plant), {i: make_observer(s) for i, s in design.nodes.items()}
    for _ in range(30):
        plant.sample()
        plant.advance()
    seen: dict[int, list] = {i: [] for i in observers}
    data, sent_all = plant.sample(), []
    for i, o in observers.items():
        o.on_round = lambda *row, i=i: seen[i].append(row)
        o.sample(data[i][:1], data[i][1:])
    for r in range(59):
        sent = {i: o.message(r).copy() for i, o in observers.items()}
        sent_all.append(sent)
        for i, o in observers.items():
            o.exchange(r, {j: sent[j] for j in design.nodes[i].hears})
    for i, rows in seen.items():
        T = design.nodes[i].matrices["T"]
        assert [row[0] for row in rows] == list(range(59))
        for (_, residual, apart), sent in zip(rows, sent_all, strict=True):
            xi = np.concatenate([np.zeros(len(T) - 1), data[i][:1]])
            assert residual == pytest.approx(np.linalg.norm(T @ sent[i] - xi))
            assert apart == max(np.linalg.norm(sent[i] - sent[j]) for j in design.nodes[i].hears)
    assert seen[1][-1][2] < 1e-3 * max(row[2] for row in seen[1])


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"observer__nu": 0}, "observer.nu.*at least 1"),
        ({"observer__gamma": 0}, "observer.gamma.*greater than 0"),
        ({"observer__gamma": -0.5}, "observer.gamma.*greater than 0"),
        ({"observer__stable_radius": 1.5}, "observer.stable_radius.*at most 1"),
        ({"observer__fusion": "fast"}, "observer.fusion"),
        ({"observer__rounds": 10}, "observer.rounds.*only with fusion: relaxed"),
        ({"observer__c": 0.1}, "observer.c.*only with fusion: relaxed"),
        ({"observer": {"method": "admm", "fusion": "finite_time", "nu": 9}}, "observer.nu.*only with fusion: admm"),
        ({"observer__normalised": False, "observer__setup": "distributed"}, "observer.setup.*nothing to set up"),
        ({"observer__poles": [0.5, 1.5]}, "observer.poles"),
    ],
)
def test_bad_options_are_named(overrides: dict, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        designed("admm_ring.yaml", **overrides)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        # without node 4 nobody follows x5
        ({"graph__edges": [[1, 2], [1, 3]]}, r"island of nodes \[1, 2, 3\].*direction\(s\)"),
        ({"graph__edges": []}, r"island of nodes \[1\].*5 direction\(s\)"),
        ({"observer__stable_radius": 0.5}, r"Assumption 2.*Zeros outside \|lambda\| < 0.5.*node 4: .*stable_radius"),
        ({"observer__alpha_factor": 3.0}, r"does not converge: spectral radius \d.*alpha_factor is too large"),
        ({"graph": {"arcs": [[1, 2], [2, 4], [4, 3], [3, 1]]}}, "needs an undirected graph"),
        ({"plant__time": "continuous", "plant__period": None, "run__step": 0.01}, "needs a discrete plant"),
    ],
)
def test_impossible_designs_are_refused_with_the_reason(overrides: dict, words: str) -> None:
    with pytest.raises(DesignError, match=words):
        designed("admm_ring.yaml", **overrides)


def test_the_missing_direction_is_named() -> None:
    """Sensors of x1 only, nothing known: five directions are missing and x1 is in none of them."""
    node = {"C": [[1, 0, 0, 0, 0, 0]], "knows": []}
    with pytest.raises(DesignError) as refusal:
        designed("admm_ring.yaml", nodes={1: node, 2: node}, graph__edges=[[1, 2]])
    text = str(refusal.value)
    assert "5 direction(s)" in text
    assert "x1" not in text.split("state: ")[1].split(". Eigenvalues")[0]


def test_a_symmetric_directed_graph_is_undirected_enough() -> None:
    both = [[1, 2], [2, 1], [2, 4], [4, 2], [4, 3], [3, 4], [3, 1], [1, 3]]
    design = designed("admm_ring.yaml", graph={"arcs": both}, run__steps=20)
    assert np.array_equal(simulate(design).xhat, simulate(designed("admm_ring.yaml", run__steps=20)).xhat)
