"""Seed 004's design: its transformations, its conditions, and the certificate against matrices built here."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from duio_mesh import DesignError, load_scenario, simulate, synthesise
from duio_mesh.geometry.subspace import GeometryError
from duio_mesh.scenario import model
from duio_mesh.synthesis import reduced_order_local, reduced_order_network
from duio_mesh.synthesis import synthesise as synthesise_aloud
from duio_mesh.synthesis.reduced_order_local import Model, interval, separate, split

TOPOLOGIES = Path(__file__).parents[2] / "topologies"
NEW_ENGLAND = {bus: k for k, bus in enumerate(range(30, 39))}  # bus -> angle's place in x; the speed is 9 further on


def load(name, **overrides):
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario(TOPOLOGIES / f"reduced_order_{name}.yaml", **dotted)


def model_of(scenario, i):
    node = scenario.nodes[i]
    return Model(scenario.plant.A, scenario.known(i), scenario.plant.E, node.C, node.noise.channel)


def phasor_unit(i, a, b):
    """Node i: angles and speeds of two machines of the New England system, one clock error on both angles."""
    C = np.zeros((4, 18))
    C[0, NEW_ENGLAND[a]] = C[1, NEW_ENGLAND[a] + 9] = C[2, NEW_ENGLAND[b]] = C[3, NEW_ENGLAND[b] + 9] = 1.0
    noise = model.Noise(np.array([[1.0], [0.0], [1.0], [0.0]]), ((),))
    return model.Node(i, C, ("p_mech30", "p_mech33"), noise)


def with_nodes(scenario, *nodes):
    return dataclasses.replace(scenario, nodes=dict(scenario.nodes) | {node.id: node for node in nodes})


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.integers(0, 10**6))
def test_the_transformation_removes_noise_and_unknown_input(seed):
    rng = np.random.default_rng(seed)
    q, r = rng.integers(1, 3), rng.integers(0, 3)
    n, p = q + rng.integers(1, 5), q + r + rng.integers(0, 3)
    A, B, D = rng.standard_normal((n, n)), rng.standard_normal((n, 2)), rng.standard_normal((n, q))
    C, F = rng.standard_normal((p, n)), rng.standard_normal((p, r))
    s = separate(Model(A, B, D, C, F), "a node", ["f"] * q)
    x, u, f, v = (rng.standard_normal(k) for k in (n, 2, q, r))
    y, dx = C @ x + F @ v, A @ x + B @ u + D @ f
    z1, z2 = np.linalg.solve(s.C11, s.W1 @ y), s.V2.T @ (x - s.U1 @ np.linalg.solve(s.C11, s.W1 @ y))
    big = max(1.0, 1 / s.margin) ** 2
    np.testing.assert_allclose(s.U1 @ z1 + s.V2 @ z2, x, atol=1e-11 * big)
    np.testing.assert_allclose(s.W2 @ y, s.C22 @ z2, atol=1e-11 * big)
    dz1 = s.A11 @ z1 + s.A12 @ z2 + s.B1 @ u + s.D1 @ f
    dz2 = s.A21 @ z1 + s.A22 @ z2 + s.B2 @ u  # no f
    np.testing.assert_allclose(s.U1 @ dz1 + s.V2 @ dz2, dx, atol=1e-10 * big)


@pytest.mark.parametrize(("name", "hidden"), [("kundur8", [4, 6, 2, 4]), ("newengland18", [4, 5, 6, 5, 6, 5])])
def test_modes_hidden_from_each_node(name, hidden):
    """Known numbers of modes with Re >= 0; each is a zero: the Rosenbrock pencil of (A, D, noise-free C) loses rank."""
    scenario = load(name)
    for i, expected in zip(scenario.nodes, hidden, strict=True):
        A, _, D, C, F = node = model_of(scenario, i)
        modes = split(separate(node, "", ()), 0.0, 3.0, "").undetectable
        assert len(modes) == expected
        quiet = linalg.null_space(F.T).T @ C
        for s in modes:
            pencil = np.block([[s * np.eye(len(A)) - A, D], [quiet, np.zeros((quiet.shape[0], D.shape[1]))]])
            assert np.linalg.svd(pencil, compute_uv=False)[-1] < 1e-9


def small(tmp_path, A, E, nodes, observer="", step=0.05, steps=1500):
    """A continuous plant in a file, nodes on a path."""
    sensors = "\n".join(f"  {i}: {{C: {C}}}" for i, C in enumerate(nodes, 1))
    edges = [[i, i + 1] for i in range(1, len(nodes))]
    (tmp_path / "small.yaml").write_text(
        f"name: small\nplant: {{time: continuous, A: {A}, E: {E}, x0: {list(range(1, len(A) + 1))}}}\n"
        f"observer: {{method: reduced_order{observer}}}\nnodes:\n{sensors}\ngraph: {{edges: {edges}}}\n"
        f"run: {{steps: {steps}, step: {step}, convergence: {{rms_below: 0.1}}}}\n"
    )
    return load_scenario(tmp_path / "small.yaml")


def last_error(design):
    trace = simulate(design)
    return np.abs(trace.xhat - trace.x)[:, -1].max()


SLOW = [[-0.3, 0.1, 0], [0.1, -0.3, 0], [0, 0, -0.2]]


def test_a_slow_system_takes_the_split_at_zero(tmp_path):
    """Every node leaves the mode at -0.2 to the network when sigma is 0.5; it goes away by itself."""
    slow = SLOW, [[1], [0], [0]], [[[1, 0, 0]], [[1, 0, 0], [0, 1, 0]]]
    said = []
    design = synthesise_aloud(small(tmp_path, *slow), said.append)
    assert (design.certificate["sigma"], design.certificate["rate"]) == (0, 3)
    assert "gains for observer.sigma = 0, observer.rate = 3" in said
    assert last_error(design) < 1e-5
    with pytest.raises(DesignError, match=r"With observer\.sigma = 0\.5 a node leaves .* a smaller observer\.sigma or"):
        synthesise(small(tmp_path, *slow, observer=", sigma: 0.5"))  # a number in the file is binding


def test_an_automatic_rate_is_halved_until_gains_are_reliable(tmp_path):
    """A chain that is seen at its far end only: no double-precision gain makes all of it faster than 3 1/s."""
    n = 8
    A = (-0.3 * np.eye(n) + 0.02 * np.eye(n, k=1)).tolist()
    chain = A, [[0]] * (n - 1) + [[1]], [[[1] + [0] * (n - 1), [0] * (n - 1) + [1]]]
    with pytest.raises(DesignError, match=r"node 1: observer\.rate = 3: .* a smaller rate may do"):
        synthesise(small(tmp_path, *chain, observer=", rate: 3"))
    design = synthesise(small(tmp_path, *chain))
    assert design.certificate["sigma"] == 0.5
    assert design.certificate["rate"] in {3 / 2**k for k in range(1, 6)}
    assert design.certificate["nodes"][1]["gain_norm"] < 1e3  # not the first gain that is barely possible
    assert last_error(design) < 1e-6


def test_what_auto_tried_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(reduced_order_network, "_RATES", (3.0, 1.5))
    monkeypatch.setattr(reduced_order_local, "stabilise", lambda *_: (_ for _ in ()).throw(GeometryError("no gain")))
    text = (
        r"observer\.rate = 1\.5: .*\(observer\.rate: auto tried 3 halved down to 1\.5\) \(observer\.sigma: auto tried"
    )
    with pytest.raises(DesignError, match=text):
        synthesise(load("kundur8"))


def test_assumption_1_is_decided_without_a_gain(tmp_path, monkeypatch):
    """The mode at 0.1 is hidden from all; no Riccati equation is solved before that is said."""
    monkeypatch.setattr(reduced_order_local, "stabilise", lambda *_: (_ for _ in ()).throw(GeometryError("no gain")))
    A = [[-1, 0, 0], [0, -2, 0], [0, 0, 0.1]]
    scenario = small(tmp_path, A, [[1], [0], [0]], [[[1, 0, 0], [0, 1, 0]], [[1, 0, 0]]])
    with pytest.raises(DesignError, match=r"Assumption 1 fails: .* do not show the modes at \['0\.1'\]"):
        synthesise(scenario)


@pytest.mark.parametrize("small_C", [1e-3, 1e-9])
@pytest.mark.parametrize("small_E", [1.0, 1e-3, 1e-9])
def test_units_do_not_decide_assumption_2(tmp_path, small_C, small_E):
    A, E = [[-1, 0.2, 0.1], [0.1, -2, 0], [0.3, 0, -1]], [[1e3, 0], [0, small_E], [0, 0]]
    C = [[1e3, 0, 0], [0, small_C, 0]]
    design = synthesise(small(tmp_path, A, E, [C, C]))
    assert design.certificate["conditions"]["assumption_2"]["value"] == pytest.approx(1)
    assert last_error(design) < 1e-6


def test_units_of_a_plant_whose_every_state_is_driven(tmp_path):
    A, I, units = [[-1, 0.2], [0.1, -2]], [[1, 0], [0, 1]], [[1e3, 0], [0, 1e-3]]
    for E, C in ((I, units), (units, I), (units, units)):
        assert last_error(synthesise(small(tmp_path, A, E, [C, C], steps=50))) < 1e-9  # x is known from y at once


def test_units_of_the_unknown_inputs_do_not_make_them_dependent(tmp_path):
    E = [[1, 1e-12], [0, 1e-12], [0, 0]]
    C = [[1, 0, 0], [0, 1, 0]]
    assert synthesise(small(tmp_path, SLOW, E, [C, C])).certificate["sampled_radius"] < 1
    with pytest.raises(DesignError, match=r"singular values of D \(columns of length 1\) are \[1\.41\d* 0\.\s*\]"):
        synthesise(small(tmp_path, SLOW, [[1, 1e-12], [0, 0], [0, 0]], [C, C]))


def test_the_scaled_separation_is_one_of_the_model_in_the_files_units():
    """Outputs, noise and unknown inputs in units far apart; the identities of the transformation still hold."""
    rng = np.random.default_rng(5)
    y, f = np.array([1e6, 1.0, 1e-4, 10.0]), np.array([1e4, 1e-4])
    A, B, D = rng.standard_normal((5, 5)), rng.standard_normal((5, 1)), rng.standard_normal((5, 2)) * f
    C, F = y[:, None] * rng.standard_normal((4, 5)), y[:, None] * rng.standard_normal((4, 1))
    s = separate(Model(A, B, D, C, F), "a node", ["f", "g"])
    assert s.margin > 1e-3
    for W in (s.W1, s.W2):
        np.testing.assert_allclose(W @ F, 0, atol=1e-12)
    T = np.hstack([s.U1, s.V2])
    np.testing.assert_allclose(s.W1 @ C @ T, np.hstack([s.C11, np.zeros((2, 3))]), atol=1e-12)
    np.testing.assert_allclose(s.W2 @ C @ s.V2, s.C22, atol=1e-12)
    np.testing.assert_allclose(s.U1 @ s.D1 / f, D / f, atol=1e-12)
    np.testing.assert_allclose(A @ T, s.U1 @ np.hstack([s.A11, s.A12]) + s.V2 @ np.hstack([s.A21, s.A22]), atol=1e-12)


def network(scenario):
    """Y and A_u of (10)-(12), the eigenvalues that nodes assign alone, and the Laplacian."""
    pairs = []
    for i in scenario.nodes:
        s = separate(model_of(scenario, i), "", ())
        pairs.append((s, split(s, 0.5, 3.0, "")))
    Y = linalg.block_diag(*(s.V2 @ g.Tu for s, g in pairs))
    own = np.concatenate([np.linalg.eigvals(g.Td.T @ (s.A22 - g.N @ s.C22) @ g.Td) for s, g in pairs])
    return Y, linalg.block_diag(*(g.Au for _, g in pairs)), own, scenario.graph.laplacian()


@pytest.mark.parametrize(("name", "bound"), [("kundur8", 352.7), ("newengland18", 860.7)])
def test_certificate_is_the_error_system_of_the_paper(name, bound):
    """(9)-(12): e = V2 (z2 - z2-hat), built with Kronecker products; the interval observer adds -kappa."""
    scenario = load(name)
    certificate = synthesise(scenario).certificate
    Y, Au, own, L = network(scenario)
    c = certificate["c"]
    coupled = np.linalg.eigvals(Au - c * Y.T @ np.kron(L, np.eye(scenario.plant.n)) @ Y)
    expected = max(coupled.real.max(), own.real.max(), -5.0)
    assert certificate["spectral_abscissa"] == pytest.approx(expected, abs=1e-6)
    assert own.real.max() < -0.5
    assert expected < -2
    assert certificate["c_bound_13"] == pytest.approx(bound, abs=0.1)
    assert certificate["c"] < 0.1 * bound  # the bound is far from what is needed
    assert certificate["largest_step"] > 2 * scenario.plant.step


def test_the_interval_contains_the_unknown_input():
    s = separate(model_of(load("newengland18"), 2), "", ())
    low, high = np.array([-1.0, -3.0]), np.array([2.0, 5.0])
    b = interval(s, low, high)
    corners = np.array([[f, g] for f in (-1, 2) for g in (-3, 5)]) @ b.G.T
    np.testing.assert_allclose(b.p_plus, corners.max(axis=0))
    np.testing.assert_allclose(b.p_plus - b.width, corners.min(axis=0))


def test_electrically_radial_machines_cannot_tell_the_loads_apart():
    text = (
        r"node 5: Assumption 2 fails: rank\(C~ D\) = 1, but rank\(D\) = 2 unknown inputs .* are \[0\.\d+, \d.*e-1\d\]"
    )
    with pytest.raises(DesignError, match=text):
        synthesise(with_nodes(load("newengland18"), phasor_unit(5, 33, 34)))


def test_two_islands_are_named():
    with pytest.raises(DesignError, match=r"strong components are \[\[1, 2\], \[3, 4\]\], and nodes \[1, 2, 3, 4\]"):
        synthesise(load("kundur8", graph={"edges": [[1, 2], [3, 4]]}))
    with pytest.raises(DesignError, match="not strongly connected"):  # 1 only talks, 4 only listens
        synthesise(load("kundur8", graph={"arcs": [[1, 2], [2, 3], [3, 4]]}))


def test_a_coupling_too_strong_for_the_step_is_refused_with_its_spectral_radius():
    with pytest.raises(
        DesignError, match=r"c = 200 is unstable at run.step = 0.01 s: the spectral radius .* is [1-9]\.\d+"
    ):
        synthesise(load("kundur8", observer__c=200))
    assert synthesise(load("kundur8", observer__c=200, run__step=0.001)).certificate["sampled_radius"] < 1


def test_largest_step_is_where_the_spectral_radius_crosses_one():
    c, limit = 20.0, synthesise(load("kundur8", observer__c=20)).certificate["largest_step"]
    assert synthesise(load("kundur8", observer__c=c, run__step=0.99 * limit)).certificate["sampled_radius"] < 1
    with pytest.raises(DesignError, match=r"is unstable at run\.step"):
        synthesise(load("kundur8", observer__c=c, run__step=1.03 * limit))


def test_a_zero_that_all_nodes_share_violates_assumption_1():
    """A ninth state that grows on its own, drives nothing and is measured by nobody."""
    scenario = load("kundur8")
    plant = scenario.plant
    larger = dataclasses.replace(
        plant,
        A=linalg.block_diag(plant.A, 0.25),
        B=np.vstack([plant.B, [0.0]]),
        E=np.vstack([plant.E, [0.0]]),
        x0=np.zeros(9),
    )
    nodes = (dataclasses.replace(n, C=np.hstack([n.C, np.zeros((3, 1))])) for n in scenario.nodes.values())
    with pytest.raises(DesignError, match=r"Assumption 1 fails: .* do not show the modes at \['0\.25'\]"):
        synthesise(with_nodes(dataclasses.replace(scenario, plant=larger), *nodes))


def test_lemma_7_is_not_enough():
    """Every sensor a phasor unit with its own clock: Assumptions 1 and 2 hold, all miss one common slow direction."""
    pairs = [(30, 31), (31, 32), (32, 33), (33, 37), (34, 37), (35, 37), (36, 37), (37, 38)]
    arcs = sorted(model.Arc(i, j, 1.0) for a in range(1, 9) for i, j in [(a, a % 8 + 1), (a % 8 + 1, a)])
    graph = model.Graph(tuple(range(1, 9)), tuple(arcs), False)
    units = [phasor_unit(i, *pair) for i, pair in enumerate(pairs, 1)]
    scenario, auto = (
        dataclasses.replace(with_nodes(load("newengland18", **given), *units), graph=graph)
        for given in ({"observer__sigma": 0.5}, {})
    )
    Y, Au, _, L = network(scenario)
    for c in (1, 10, 100, 1000):  # the paper promises that a large c is enough
        assert np.linalg.eigvals(Au - c * Y.T @ np.kron(L, np.eye(18)) @ Y).real.max() > 0.01
    with pytest.raises(DesignError, match=r"1 direction\(s\) of the state are left to the network by every node"):
        synthesise(scenario)
    found = synthesise(auto).certificate  # the direction is stable: the split at 0 keeps it with a node, slowly
    assert (found["sigma"], found["rate"]) == (0, 3)
    assert -0.03 < found["spectral_abscissa"] < 0


def test_what_the_method_cannot_do_is_said():
    scenario = load("kundur8")
    second = scenario.nodes[2]
    with pytest.raises(DesignError, match=r"node 1 knows \['p_mech1'\], node 2 knows \[\]"):
        synthesise(with_nodes(scenario, dataclasses.replace(second, knows=())))
    with pytest.raises(DesignError, match="needs a continuous plant"):
        synthesise(dataclasses.replace(scenario, plant=dataclasses.replace(scenario.plant, time="discrete")))
    with pytest.raises(DesignError, match=r"one \[low, high\] with low < high for each of the 1 unknown inputs"):
        synthesise(load("kundur8", observer__bounds=[[-1, 1], [-1, 1]]))
    dependent = model.Noise(np.array([[1.0, 1.0], [1.0, 1.0], [2.0, 2.0]]), ((), ()))
    with pytest.raises(DesignError, match=r"node 2: the noise channel .* must have independent columns"):
        synthesise(with_nodes(scenario, dataclasses.replace(second, noise=dependent)))
