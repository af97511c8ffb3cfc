"""Seed 003's design: subspaces, gains and bounds of its examples, the failure of its bound, and the refusals."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import DesignError, load_scenario, synthesise
from duio_mesh.synthesis.geometric_local import local_uio

TOPOLOGIES = Path(__file__).parents[2] / "topologies"
GRAPHS = {
    "ring": [(1, 2), (2, 3), (3, 4), (4, 1)],
    "path": [(1, 2), (2, 3), (3, 4)],
    "star1": [(1, 2), (1, 3), (1, 4)],
    "star2": [(2, 1), (2, 3), (2, 4)],
    "star3": [(3, 1), (3, 2), (3, 4)],
    "path2134": [(2, 1), (1, 3), (3, 4)],
    "path2143": [(2, 1), (1, 4), (4, 3)],
    "path3124": [(3, 1), (1, 2), (2, 4)],
    "complete": list(itertools.combinations(range(1, 5), 2)),
}


def load(name="ring", **overrides):
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario(TOPOLOGIES / f"geometric_{name}.yaml", **dotted)


def on(graph, **overrides):
    return load(graph__edges=[list(edge) for edge in GRAPHS[graph]], **overrides)


def local(scenario, i, kappa=0.0):
    poles = scenario.options.poles
    return local_uio(scenario.nodes[i].C, scenario.plant.A, scenario.known(i), scenario.unknown(i), poles, kappa, "")


def test_the_centralised_gain_is_the_published_one():
    node = local(load("centralised"), 1)
    np.testing.assert_allclose(node.L, [[-5, 5], [5, -5], [20, -18]], atol=1e-10)
    np.testing.assert_allclose(np.sort(node.own), [-4, -3], atol=1e-10)
    assert node.hidden == 0
    certificate = synthesise(load("centralised")).certificate
    assert certificate["spectral_abscissa"] == pytest.approx(-3, abs=1e-9)
    assert certificate["conditions"]["lemma_2"]["value"] == [1]


@pytest.mark.parametrize(
    ("i", "group", "dims", "zeros", "L"),
    [
        (1, "N1", (1, 4, 2, 3), [-2, 12**0.5 * 1j, -(12**0.5) * 1j], [[-5, 0, 0, 0, 0, 0], [0, -1, 0, 3, 3, 0]]),
        (2, "N2", (2, 6, 3, 5), [-2, 0, 6**0.5 * 1j, -(6**0.5) * 1j], [[0, -2, 0, 0, 0, -4]]),
        (3, "N1", (1, 4, 3, 4), [0, 12**0.5 * 1j, -(12**0.5) * 1j], [[0, 0, -3, 3, 0, 0], [-3, 1, 0, 0, 3, -1]]),
        (4, "N2", (5, 6, 0, 5), [-3], [[-3, 0, 0, 0, 0, 0]]),
    ],
)
def test_subspaces_zeros_and_gains_of_the_four_nodes(i, group, dims, zeros, L):
    scenario = load()
    node = local(scenario, i)
    s = node.structure
    assert node.group == group
    assert tuple(M.shape[1] for M in (s.W, s.S, s.V, s.Wg)) == dims
    np.testing.assert_allclose(np.sort_complex(s.zeros.round(9)), np.sort_complex(np.round(zeros, 9)), atol=1e-8)
    np.testing.assert_allclose(node.L.T, L, atol=1e-9)
    A, B, C = scenario.plant.A, scenario.unknown(i), scenario.nodes[i].C
    for z in s.zeros:  # each makes the Rosenbrock pencil lose rank
        pencil = np.block([[z * np.eye(6) - A, -B], [C, np.zeros((C.shape[0], B.shape[1]))]])
        generic = np.linalg.matrix_rank(pencil + np.eye(*pencil.shape) * (0.3 + 0.7j), tol=1e-8)
        assert np.linalg.matrix_rank(pencil, tol=1e-8) < generic


@pytest.mark.parametrize("graph", ["ring", "star1"])
@pytest.mark.parametrize("kappa", [0.0, 10.0])
def test_spectral_abscissa_is_that_of_plant_and_observers_together(graph, kappa):
    """The whole linear system [x; z_1; ...; z_4] has the plant's eigenvalues and those of the error, and no others."""
    scenario = on(graph, observer__kappa=kappa)
    A, n, chi = scenario.plant.A, 6, 10.0
    nodes = {i: local(scenario, i, kappa) for i in scenario.nodes}
    own = linalg.block_diag(*(node.local.A for node in nodes.values()))
    from_x = np.vstack(
        [nodes[i].local.Y @ scenario.nodes[i].C + nodes[i].local.U @ np.zeros((2 if i < 4 else 1, n)) for i in nodes]
    )
    estimates_z = linalg.block_diag(*(node.X for node in nodes.values()))
    estimates_x = np.vstack([nodes[i].F @ scenario.nodes[i].C for i in nodes])
    push = -chi * linalg.block_diag(*(node.local.K @ node.R for node in nodes.values()))
    push = push @ np.kron(scenario.graph.laplacian(), np.eye(n))
    whole = np.block([[A, np.zeros((n, own.shape[0]))], [from_x + push @ estimates_x, own + push @ estimates_z]])
    values = list(np.linalg.eigvals(whole))
    for plant in np.linalg.eigvals(A):
        values.pop(int(np.argmin(np.abs(np.array(values) - plant))))
    largest = synthesise(scenario).certificate["spectral_abscissa"]
    assert largest == pytest.approx(np.real(values).max(), abs=1e-7)
    if not kappa:
        assert largest == pytest.approx({"ring": -1.344, "star1": -0.873}[graph], abs=1e-3)


@pytest.mark.parametrize(
    ("graph", "bound"), [("ring", 71.66), ("path", 98.45), ("star1", 153.65), ("star2", 96.11), ("complete", 45.29)]
)
def test_bound_21_is_reported(graph, bound):
    certificate = synthesise(on(graph)).certificate
    assert certificate["chi_bound_21"] == pytest.approx(bound, abs=0.01)
    assert certificate["chi"] < bound / 4  # and not obeyed
    assert certificate["gamma_needed"] == pytest.approx(0.2 * 2**0.5, abs=1e-9)
    assert certificate["gamma_needed"] < certificate["gamma_bound_21"] < 1
    assert certificate["conditions"]["gamma"]["ok"]
    assert not synthesise(on(graph, observer__gamma=0.2)).certificate["conditions"]["gamma"]["ok"]


@pytest.mark.parametrize(
    ("graph", "growth"), [("star1", "0.0509"), ("path2143", "0.105"), ("path3124", "0.159"), ("path2134", "0.00048")]
)
def test_above_its_own_bound_the_paper_is_unstable_on_four_graphs(graph, growth):
    chi = 1.05 * synthesise(on(graph, observer__chi="auto")).certificate["chi_bound_21"]
    with pytest.raises(DesignError, match=rf"unstable at any step: .* real part {growth}"):
        synthesise(on(graph, observer__chi=chi, run__step=1e-4))


@pytest.mark.parametrize("graph", sorted(GRAPHS))
def test_moderate_chi_works_on_every_graph_and_kappa_cures_large_ones(graph):
    certificate = synthesise(on(graph, observer__chi="auto")).certificate
    assert certificate["spectral_abscissa"] < -1.4
    assert certificate["largest_step"] >= 1.5 * 0.005
    for chi in (225, 2000):
        cured = synthesise(on(graph, observer__chi=chi, observer__kappa=10, run__step=2e-5))
        assert cured.certificate["spectral_abscissa"] < -1.5


def test_a_node_alone_must_satisfy_lemma_2():
    with pytest.raises(
        DesignError, match=r"node 1 has no neighbours .* have 2 common direction\(s\) .* bad zeros are \[\]"
    ):
        synthesise(load("centralised", nodes__1__C=[[1, -1, 0]], observer__poles=[-3, -4, -5]))
    with pytest.raises(DesignError, match=r"node 1 has no neighbours .* bad zeros are \['0 \+- 3.464j'\]"):
        synthesise(load(graph__edges=[[2, 3], [3, 4]]))


def test_islands_that_miss_the_same_direction_are_refused():
    with pytest.raises(DesignError, match=r"Assumption 3 fails for nodes \[1, 3\]: 1 direction.*\{1: 2, 3: 3\}"):
        synthesise(load(graph__edges=[[1, 3], [2, 4]]))


def test_a_step_that_is_too_long_is_refused():
    limit = synthesise(load()).certificate["largest_step"]
    assert 0.02 < limit < 0.0493  # 2 / (chi lambda_max) = 0.05 without the sign term
    with pytest.raises(
        DesignError, match=r"chi = 10 is unstable at run.step = 0.03 s: the spectral radius .* is 1\.\d+"
    ):
        synthesise(load(run__step=0.03))
    assert synthesise(load(run__step=0.03, observer__sign="sign")).certificate["sampled_radius"] < 1
    with pytest.raises(DesignError, match=r"no chi between .* makes the sampled error system stable"):
        synthesise(load(run__step=2.0, observer__chi="auto", observer__gamma=0))


def test_what_the_method_cannot_do_is_said():
    scenario = load()
    with pytest.raises(DesignError, match="needs a continuous plant"):
        synthesise(dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, time="discrete")))
    with pytest.raises(DesignError, match="needs an undirected graph"):
        synthesise(dataclasses.replace(scenario, graph=dataclasses.replace(scenario.graph, directed=True)))
    with pytest.raises(DesignError, match=r"node 1: 2 poles can be placed .* but only 1 are given"):
        synthesise(load(observer__poles=[-2]))


MARGINAL = """
name: marginal
plant:
  time: continuous
  A: [[0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
  B: [[0, -1.29], [0, -1.69], [0, -1.12], [1, 0.89]]
  inputs: [u0, u1]
  control: {signals: {u0: {constant: {value: 1}}, u1: {constant: {value: 1}}}}
  x0: [0, 0, 0, 0]
observer: {method: geometric}
nodes:
  1: {C: [[0, 0, 0, 1], [1, 0, 0, 0]], knows: [u0]}
  2: {C: [[0, 0, 0, 1], [0, 1, 0, 0]]}
graph: {edges: [[1, 2]]}
run: {steps: 10, step: 0.01, convergence: {rms_below: 1}}
"""


@pytest.mark.parametrize("chi", ["auto", 1.0])
def test_a_marginal_error_system_is_refused(tmp_path, chi):
    (tmp_path / "marginal.yaml").write_text(MARGINAL, "utf-8")
    words = "A shorter step cannot help; .* kappa" if chi == "auto" else "chi = 1 is unstable at any step: .* kappa"
    with pytest.raises(DesignError, match=words):
        synthesise(load_scenario(tmp_path / "marginal.yaml", **{"observer.chi": chi}))
