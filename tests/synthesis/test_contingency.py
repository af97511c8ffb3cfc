"""What is left after a loss: against stacked matrices from the plant itself, and against runs on the smaller graph."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.cli import main
from duio_mesh.scenario.model import Arc, Graph
from duio_mesh.synthesis.contingency import contingency, with_contingency
from duio_mesh.synthesis.losses import Loss, links, losses, without
from tests.conftest import TOPOLOGIES

ARCS = tuple(Arc(a, b, 1.0) for a, b in [(1, 2), (2, 1), (2, 3), (3, 2)])
PATH = Graph((1, 2, 3), ARCS, directed=False)


def designed(name, **overrides):
    return synthesise(
        load_scenario(TOPOLOGIES / f"{name}.yaml", **{k.replace("__", "."): v for k, v in overrides.items()})
    )


def by_loss(found):
    return {case["lost"]: case for case in found["cases"]}


def stacked_lmi(scenario, g, edges, alive):
    """Spectral radius of (31) from the plant's matrices: unobservable subspaces by powers, Kronecker form."""
    A, n, Phi = scenario.plant.A, scenario.plant.n, []
    L = np.zeros((len(alive), len(alive)))
    for a, b in edges:
        if a in alive and b in alive:
            i, j = alive.index(a), alive.index(b)
            L[[i, j], [j, i]] -= 1
            L[[i, j], [i, j]] += 1
    pulls = []
    for i in alive:
        C, B = scenario.nodes[i].C, scenario.unknown(i)
        B = B[:, np.abs(B).max(axis=0) > 0]
        P = np.eye(n) - B @ np.linalg.pinv(C @ B) @ C
        seen = np.vstack([C @ np.linalg.matrix_power(P @ A, k) for k in range(n)])
        U = np.linalg.svd(seen)[2][np.linalg.matrix_rank(seen, 1e-9) :].T
        Phi.append(P @ A)  # K_i is inert in this example
        pulls.append(g[i] * U @ U.T)
    stacked = np.kron(np.eye(len(alive)), np.eye(n)) * 0
    for i, block in enumerate(Phi):
        at = slice(i * n, (i + 1) * n)
        stacked[at, at] += block
        stacked[at] -= pulls[i] @ np.kron(L[i : i + 1], np.eye(n))
    return np.abs(np.linalg.eigvals(stacked)).max()


def test_heat_ring_against_the_plant():
    design = designed("ring")
    found = contingency(design)
    json.dumps(found, allow_nan=False)
    scenario, g = design.scenario, dict(zip(design.nodes, design.certificate["g"], strict=True))
    edges, ids = [(1, 2), (1, 4), (2, 3), (3, 4)], [1, 2, 3, 4]
    assert [case["lost"] for case in found["cases"]] == [f"edge {a}-{b}" for a, b in edges] + [f"node {i}" for i in ids]
    for case in found["cases"]:
        left = [e for e in edges if list(e) not in case["links"]]
        alive = [i for i in ids if i not in case["nodes"]]
        assert case["radius"] == pytest.approx(stacked_lmi(scenario, g, left, alive), abs=1e-8)
        assert case["reconstructs"] is True
    assert found["nominal"] == pytest.approx(design.certificate["spectral_radius"], abs=1e-12)
    assert found["survives"] is True
    assert found["worst"] == max(found["cases"], key=lambda c: c["radius"])["lost"]


def growth(design, cut):
    """Error per step of the designed nodes run without these edges, noise-free."""

    def deaf(spec, i):
        gone = {b for a, b in cut if a == i} | {a for a, b in cut if b == i}
        hears = {j: w for j, w in spec.hears.items() if j not in gone}
        return replace(spec, hears=hears, tells=tuple(j for j in spec.tells if j not in gone))

    trace = simulate(replace(design, nodes={i: deaf(spec, i) for i, spec in design.nodes.items()}))
    errors = np.linalg.norm(trace.xhat - trace.x, axis=2).max(axis=0)
    half = len(errors) // 2
    return (errors[-half // 4 :].max() / errors[half : half + half // 4].max()) ** (1 / (half - half // 4))


@pytest.mark.parametrize(("name", "steps"), [("six_state_ring", 200), ("augmented_heat_ring", 200)])
def test_the_radius_is_what_a_run_does(name, steps):
    design = designed(name, run__steps=steps, plant__noise={"std": 0})
    cases = contingency(design)["cases"]
    for case in (cases[0], cases[-len(design.nodes) - 1]):  # the first and the last edge
        assert growth(design, [tuple(case["links"][0])]) == pytest.approx(case["radius"], abs=0.01)
        assert case["reconstructs"] == (case["radius"] < 1)


@pytest.mark.parametrize("name", ["geometric_star", "reduced_order_kundur8", "admm_ring", "relaxed_ring"])
def test_nothing_lost_is_the_certificate(name):
    design = designed(name)
    promised = design.certificate
    nominal = promised.get("sampled_radius") or max(island["fusion_radius"] for island in promised["islands"])
    assert contingency(design)["nominal"] == pytest.approx(nominal, rel=1e-9)


def test_a_lost_hub_leaves_lone_nodes():
    found = by_loss(contingency(designed("geometric_star")))
    assert found["node 1"]["failing"] == [[2], [3], [4]]
    assert found["node 3"]["reconstructs"]
    assert not found["edge 1-2"]["reconstructs"]


def test_admm_says_when_the_rest_sees_too_little_and_how_much_a_step_leaves():
    design = designed("admm_ring")
    found = by_loss(contingency(design))
    for i in (1, 2, 3, 4):
        T = np.vstack([design.nodes[j].matrices["T"] for j in design.nodes if j != i])
        assert found[f"node {i}"]["reconstructs"] == (np.linalg.matrix_rank(T, 1e-6) == T.shape[1])
    assert found["node 1"]["left"] > 0.5 > found["edge 1-2"]["left"]


def test_finite_time_survives_nothing():
    """Its rounds belong to one graph: with another it ends beside the mean."""
    found = contingency(designed("finite_time_ring"))
    assert found["nominal"] == 0
    assert not any(case["reconstructs"] or case["radius"] is not None for case in found["cases"])


def test_losses_of_a_path():
    assert links(PATH) == ((1, 2), (2, 3))
    assert [loss.words(PATH) for loss in losses(PATH, 1)] == ["edge 1-2", "edge 2-3", "node 1", "node 2", "node 3"]
    double = [loss.words(PATH) for loss in losses(PATH, 2)][5:]
    assert "edge 1-2, edge 2-3" in double
    assert "edge 1-2, node 3" in double
    assert "edge 1-2, node 1" not in double  # the edge goes with its node
    assert without(PATH, Loss(((1, 2),))).islands() == ((1,), (2, 3))
    assert without(PATH, Loss((), (2,))).arcs == ()
    directed = Graph((1, 2, 3), ARCS[:2], directed=True)
    assert without(directed, Loss(((1, 2),))).arcs == ARCS[1:2]
    assert Loss(((1, 2),)).words(directed) == "arc 1->2"


def test_the_certificate_carries_it_and_the_command_line_prints_it(capsys):
    assert with_contingency(designed("ring"), 1).certificate["contingency"]["survives"] is True
    assert main([str(TOPOLOGIES / "six_state_ring.yaml"), "--check", "--contingency", "1"]) == 0
    out = capsys.readouterr().out
    assert "edge 1-2" in out
    assert "0 of 10" in out
    with pytest.raises(SystemExit) as stopped:
        main([str(TOPOLOGIES / "ring.yaml"), "--contingency", "1"])
    assert stopped.value.code == 2
