"""Theorem 8 (iv): three tests against each other, SLICOT's zeros and planted modes; directed graphs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import slycot
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.geometry import detectability_decomposition, intersection, stable_radius
from duio_mesh.scenario.model import Arc, Graph
from duio_mesh.synthesis.augmented_existence import (
    View,
    check,
    components,
    unseen_by_subspaces,
    unseen_centrally,
    unseen_jointly,
)
from duio_mesh.synthesis.uio import decouple

TOPOLOGIES = Path(__file__).parents[2] / "topologies"
SCHUR = stable_radius()


def view(C, D):
    own = decouple(np.array(C, dtype=float), np.array(D, dtype=float))
    return View(np.array(C, dtype=float), own.P, own.basis)


def verdicts(views, A):
    return (
        unseen_jointly(views, A, SCHUR).nu,
        unseen_centrally(views, A, SCHUR).nu,
        unseen_by_subspaces(views, A, SCHUR).shape[1],
    )


def random_integer_system(seed):
    """One or two nodes with one or two outputs, a disturbance for all and at most one input of their own."""
    rng = np.random.default_rng(seed)
    n, N = int(rng.integers(3, 6)), int(rng.integers(1, 3))
    A, E = rng.integers(-1, 2, (n, n)).astype(float), rng.integers(-1, 2, (n, 1)).astype(float)
    views = []
    while len(views) < N:
        p = int(rng.integers(1, 3))
        C = rng.integers(-1, 2, (p, n)).astype(float)
        D = np.hstack([E, rng.integers(-1, 2, (n, p - 1))])
        if np.linalg.matrix_rank(C) == p and np.linalg.matrix_rank(C @ D) == np.linalg.matrix_rank(D):
            views.append(view(C, D))
        else:
            E = rng.integers(-1, 2, (n, 1)).astype(float) if not views else E
    return A, views


def unstable_zeros(views, A):
    """Of (A, D_0, all C) by SLICOT: what a centralised observer with the commonly unknown inputs cannot see."""
    C = np.vstack([v.C for v in views])
    D0 = views[0].D
    for v in views[1:]:
        D0 = intersection(D0, v.D)
    n, m, p = len(A), D0.shape[1], len(C)
    k, *_, Af, Bf = slycot.ab08nd(n, m, p, A, D0, C, np.zeros((p, m)), tol=1e-10)
    zeros = linalg.eigvals(Af[:k, :k], Bf[:k, :k]) if k else np.zeros(0)
    return int(np.sum(np.abs(zeros) >= 1 - 1e-6))


def test_three_tests_agree_with_each_other_and_with_slicot_on_500_integer_systems():
    solvable = 0
    for seed in range(500):
        A, views = random_integer_system(seed)
        joint, central, subspaces = verdicts(views, A)
        assert bool(joint) == bool(central) == bool(subspaces), seed
        assert central == unstable_zeros(views, A), seed
        solvable += joint == 0
    assert 100 <= solvable <= 400


def test_solvable_although_the_undetectable_subspaces_have_a_line_in_common():
    """The condition of the paper's [2] and [22] is sufficient only."""
    A = np.array([[0, 0, 0, 1], [1, 0, 1, 1], [0, 0, 1, 0], [0, 1, -1, -1]], dtype=float)
    views = [
        view([[0, 0, -1, -1], [1, 1, 1, 1]], [[0, -1], [0, 0], [1, 0], [0, -1]]),
        view([[0, 0, 1, 0], [-1, -1, 0, -1]], [[0, -1], [1, 1], [-1, 0], [0, -1]]),
    ]
    U = [detectability_decomposition(v.C, v.P @ A, SCHUR).U for v in views]
    assert intersection(*U).shape[1] == 1
    assert verdicts(views, A) == (0, 0, 0)


@st.composite
def planted(draw):
    """Nodes that all miss one invariant subspace: a real mode, a Jordan block, or a complex pair, |lambda| > 1."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    radius = draw(st.floats(1.01, 2.0))
    kind = draw(st.sampled_from(["real", "jordan", "complex"]))
    angle = draw(st.floats(0.2, 2.9))
    n, N = draw(st.integers(4, 6)), draw(st.integers(1, 4))
    hidden = {
        "real": np.array([[radius]]),
        "jordan": np.array([[radius, 1.0], [0.0, radius]]),
        "complex": radius * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]),
    }[kind]
    k = len(hidden)
    T = linalg.qr(rng.standard_normal((n, n)))[0]
    A = np.block(
        [[hidden, rng.standard_normal((k, n - k))], [np.zeros((n - k, k)), rng.standard_normal((n - k, n - k))]]
    )
    E = rng.standard_normal((n, 1))
    views = []
    for i in range(N):
        C = np.hstack([np.zeros((2, k)), rng.standard_normal((2, n - k))])
        D = np.hstack([E, rng.standard_normal((n, 1))]) if i % 2 else E
        views.append(view(C @ T.T, T @ D))
    return T @ A @ T.T, views, T[:, :k], np.linalg.eigvals(hidden), rng


@settings(deadline=None, derandomize=True, max_examples=60)
@given(planted())
def test_planted_modes_are_found_and_named_and_one_more_output_cures_them(system):
    A, views, hidden, values, rng = system
    assert verdicts(views, A) == (len(values),) * 3
    ids = tuple(range(1, len(views) + 1))
    ring = Graph(ids, tuple(Arc(i, j, 1.0) for i in ids for j in ids if i != j), directed=False)
    with pytest.raises(DesignError, match=r"Theorem 8 \(iv\) fails: the mode with eigenvalue") as refused:
        check(ring, dict(zip(ids, views, strict=True)), A, SCHUR)
    named = re.search(r"eigenvalue (\S+) along v = \((.*?)\) is seen", str(refused.value))
    value, v = number(named[1]), np.array([number(entry) for entry in named[2].split(", ")])
    assert np.abs(values - value).min() < 1e-4  # a double eigenvalue splits by the square root of the rounding error
    assert np.linalg.norm(v - hidden @ (hidden.T @ v)) < 1e-4 * np.linalg.norm(v)
    C = np.vstack([views[0].C, rng.standard_normal((1, len(A)))])
    cured = [view(C, views[0].D), *views[1:]]
    assert verdicts(cured, A) == (0, 0, 0)
    assert [source["nodes"] for source in check(ring, dict(zip(ids, cured, strict=True)), A, SCHUR)] == [list(ids)]


def number(text):
    return complex(text.replace("i", "j"))


def arcs(*pairs):
    ids = tuple(sorted({i for pair in pairs for i in pair}))
    return Graph(ids, tuple(sorted(Arc(i, j, 1.0) for i, j in pairs)), directed=True)


def test_components_and_which_of_them_hear_nobody():
    graph = arcs((1, 2), (2, 1), (2, 3), (4, 3), (3, 5), (5, 3))
    assert [(c.ids, c.source) for c in components(graph)] == [((1, 2), True), ((3, 5), False), ((4,), True)]
    alone = Graph((1, 2), (), directed=False)
    assert [(c.ids, c.source) for c in components(alone)] == [((1,), True), ((2,), True)]


def example9(**graph):
    return load_scenario(TOPOLOGIES / "augmented_directed.yaml", graph=graph)


@pytest.mark.parametrize(
    ("graph", "node", "value"),
    [
        ({"arcs": [[3, 2], [2, 1]]}, "node 3", "1.8"),
        ({"arcs": [[2, 3], [3, 1]]}, "node 2", "1.2"),
        ({"edges": [[1, 2]]}, "node 3", "1.8"),
        ({"edges": []}, "node 2", "1.2"),
    ],
)
def test_a_source_component_must_manage_with_its_own_sensors(graph, node, value):
    with pytest.raises(DesignError, match=rf"^{node}: .*eigenvalue {value} along v = \(.*hears nobody else"):
        synthesise(example9(**graph))


def test_the_refused_directed_path_has_a_fixed_mode_although_its_pair_is_detectable():
    """3 -> 2 -> 1: Theorem 6 (v) holds, yet 1.8 stays an eigenvalue whatever K is, so (v) is not enough here."""
    scenario = example9(arcs=[[2, 3], [3, 2], [3, 1]])
    A = scenario.plant.A
    P = [decouple(node.C, scenario.unknown(i)).P for i, node in scenario.nodes.items()]
    rng = np.random.default_rng(1)
    N = linalg.block_diag(
        *[Pi @ A - rng.standard_normal((3, 2)) @ node.C for Pi, node in zip(P, scenario.nodes.values(), strict=True)]
    )
    lap = np.array([[1, -1, 0], [0, 1, -1], [0, 0, 0]], dtype=float)
    assert detectability_decomposition(np.kron(lap, np.eye(3)), N, SCHUR).nu == 0
    for _ in range(20):
        K = linalg.block_diag(*rng.standard_normal((3, 3, 3)))
        assert np.abs(np.linalg.eigvals(N + K @ np.kron(lap, np.eye(3))) - 1.8).min() < 1e-9


@pytest.mark.parametrize("graph", [{"arcs": [[1, 2], [2, 3]]}, {"edges": [[2, 3]]}, {"arcs": [[1, 2], [2, 3], [3, 1]]}])
def test_other_directed_and_disconnected_graphs_are_solvable(graph):
    design = synthesise(example9(**graph))
    assert design.certificate["spectral_radius"] < 0.9


def test_lemma_4_is_checked_node_by_node():
    scenario = load_scenario(TOPOLOGIES / "augmented_example9.yaml", **{"nodes.2.C": [[0, 0, 1]]})
    with pytest.raises(DesignError, match="node 2: Assumption 2 fails"):
        synthesise(scenario)


def test_a_continuous_plant_is_refused():
    path = TOPOLOGIES / "reduced_order_kundur8.yaml"
    with pytest.raises(DesignError, match="needs a discrete plant"):
        synthesise(load_scenario(path, observer={"method": "augmented"}))
