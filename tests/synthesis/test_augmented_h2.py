"""The structured H2 design: its gradient, its figures on three systems, and what enters its cost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, optimize

from duio_mesh import load_scenario, synthesise
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.scenario.model import OpenLoop
from duio_mesh.synthesis import synthesise as synthesise_aloud
from duio_mesh.synthesis.augmented_error import ErrorSystem, Network, Sensor
from duio_mesh.synthesis.augmented_h2 import Cost, h2_gains, mild_filter

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def load(name, **overrides):
    return load_scenario(
        TOPOLOGIES / f"augmented_{name}.yaml", **{k.replace("__", "."): v for k, v in overrides.items()}
    )


def certificate(name, **overrides):
    return synthesise(load(name, **overrides)).certificate


def random_network(N, n, seed, delay=0, radius=1.1):
    """A ring of nodes with two outputs; everybody misses one input, every second node another one."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    E, sensors = rng.standard_normal((n, 1)), []
    for i in range(N):
        C = rng.standard_normal((2, n))
        D = np.hstack([E, rng.standard_normal((n, 1))]) if i % 2 else E
        H = D @ np.linalg.pinv(C @ D)
        half = rng.standard_normal((2, 2))
        sensors.append(Sensor(C, np.eye(n) - H @ C, H, half @ half.T))
    W = np.zeros((N, N))
    for i in range(N):
        W[i, (i + 1) % N] = W[(i + 1) % N, i] = rng.uniform(0.5, 2.0)
    return Network(A, tuple(sensors), np.diag(W.sum(axis=1)) - W, delay)


@pytest.mark.parametrize(("delay", "beta"), [(0, [0, 0, 0]), (0, [2, 0, 1]), (1, [1, 0, 0])])
def test_the_gradient_is_exact(delay, beta):
    network = random_network(3, 3, seed=4, delay=delay, radius=0.9)
    system = ErrorSystem(network, beta)
    theta = 0.05 * np.random.default_rng(0).standard_normal(int(system.free.sum()))
    cost = Cost(system, transient=3.0, gamma=1.2 * spectral_radius(system.matrix(full(system, theta))))
    value, gradient = cost(theta)
    assert np.isfinite(value)
    numeric = optimize.approx_fprime(theta, lambda x: cost(x)[0], 1e-6)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())


def full(system, theta):
    Theta = np.zeros(system.free.shape)
    Theta[system.free] = theta
    return Theta


def test_the_cost_is_the_noise_covariance_plus_the_price_of_transients():
    network = random_network(3, 3, seed=4, radius=0.2)
    system = ErrorSystem(network, [1, 0, 0])
    theta = 0.02 * np.random.default_rng(1).standard_normal(int(system.free.sum()))
    value, _ = Cost(system, transient=2.5, gamma=1.0)(theta)
    Phi = system.matrix(full(system, theta))
    V = linalg.block_diag(*[s.V for s in network.sensors])
    Gamma = system.noise_input(Phi, full(system, theta))
    start = np.zeros_like(Phi)
    start[:9, :9] = np.eye(9)
    mean_variance = np.trace(V) / len(V)
    X = linalg.solve_discrete_lyapunov(Phi, Gamma @ V @ Gamma.T / mean_variance + 2.5 * start)
    assert np.isfinite(value)
    assert value == pytest.approx(np.trace(X[:9, :9]), rel=1e-10)


@pytest.mark.parametrize(
    ("name", "radius", "peak"), [("example9", 0.57, 1.6), ("six_state", 0.83, 1.3), ("heat_ring", 0.921, 1.0)]
)
def test_figures_of_the_three_systems(name, radius, peak):
    found = certificate(name)
    assert found["spectral_radius"] <= radius
    assert found["peak"] <= peak * (1 + 1e-12)
    assert all(condition["ok"] for condition in found["conditions"].values())
    assert all(node["beta"] == 0 for node in found["nodes"].values())


@pytest.mark.parametrize(
    ("name", "radius", "peak"), [("example9", 0.70, 6.6), ("six_state", 0.91, 2.6), ("heat_ring", 0.922, 1.5)]
)
def test_designs_for_neighbours_that_are_one_step_late(name, radius, peak):
    found = certificate(name, observer__delay=1)
    assert found["spectral_radius"] <= radius
    assert found["peak"] <= peak


@pytest.mark.parametrize("name", ["example9", "six_state", "heat_ring"])
def test_the_synchronous_gains_are_unstable_when_every_message_is_late(name):
    given = []
    for i, node in synthesise(load(name)).nodes.items():
        M = node.matrices
        given.append({"node": i, "F": (M["L"] - M["N"] @ M["H"]).tolist(), "K": M["K"].tolist()})
    with pytest.raises(DesignError, match="spectral radius of the whole error system is"):
        synthesise(load(name, observer={"method": "augmented", "delay": 1, "gains": {"given": given}}))


@pytest.mark.parametrize(("N", "n", "seed"), [(4, 6, 600), (5, 6, 605), (6, 8, 802)])
def test_unstable_random_networks_are_stabilised_without_augmented_states(N, n, seed):
    network = random_network(N, n, seed)
    gains = h2_gains(network, [0] * N, transient=100.0, rate=1.0, starts=2, seed=0, progress=lambda _: None)
    system = ErrorSystem(network, [0] * N)
    assert spectral_radius(network.A) > 1.09
    assert spectral_radius(system.matrix(system.theta(gains))) < 0.99


def test_augmented_states_can_be_asked_for_per_node():
    found = certificate("example9", observer__gains={"h2": {"extra_states": [2, 0, 1]}})
    assert [node["beta"] for node in found["nodes"].values()] == [2, 0, 1]
    assert found["spectral_radius"] < 0.57
    with pytest.raises(DesignError, match="extra_states should have 3 entries"):
        certificate("example9", observer__gains={"h2": {"extra_states": [2, 0]}})


def test_the_files_noise_covariance_enters_the_cost():
    """A design that is told of one bad sensor beats, under that noise, the one that believes in equal sensors."""
    # noise of std 1e-3 at nodes 1 and 3, 1e-1 at node 2
    noise = {"nodes.1.noise": {"std": 1e-3}, "nodes.2.noise": {"std": 0.1}, "nodes.3.noise": {"std": 1e-3}}
    options = {"method": "augmented", "gains": {"h2": {"transient": 0.01}}}
    told = synthesise(load("example9", **noise, observer=options))
    blind = synthesise(load("example9", observer=options))
    given = [
        {"node": i, "F": (s.matrices["L"] - s.matrices["N"] @ s.matrices["H"]).tolist(), "K": s.matrices["K"].tolist()}
        for i, s in blind.nodes.items()
    ]
    same = synthesise(load("example9", **noise, observer={"method": "augmented", "gains": {"given": given}}))

    def mean_square(design):
        return sum(node["predicted_rms"] ** 2 for node in design.certificate["nodes"].values())

    assert mean_square(told) < 0.9 * mean_square(same)


def test_more_weight_on_transients_is_faster_and_noisier():
    quick = certificate("six_state", observer__gains={"h2": {"transient": 100.0}})
    calm = certificate("six_state", observer__gains={"h2": {"transient": 0.1}})
    assert quick["spectral_radius"] < calm["spectral_radius"]
    assert all(calm["nodes"][i]["predicted_rms"] < quick["nodes"][i]["predicted_rms"] for i in quick["nodes"])


@pytest.mark.parametrize(
    ("name", "rate", "peak"), [("example9", 0.01, 2.5), ("six_state", 0.3, 3.0), ("heat_ring", 0.9, 1.7)]
)
def test_a_wanted_rate_is_kept(name, rate, peak):
    """Nearly deadbeat without augmented states and with small transients (the paper's own gains peak at 5e4)."""
    found = certificate(name, observer__rate=rate)
    assert found["spectral_radius"] < rate
    assert found["peak"] < peak


def test_a_rate_that_is_not_reached_is_refused():
    with pytest.raises(DesignError, match=r"no gains with a spectral radius below 1e-05 from 2 starts \(closest: 0\.0"):
        certificate("example9", observer__rate=1e-5, observer__gains={"h2": {"starts": 2}})


def hard(tmp_path, observer=""):
    """Six compartments, two unknown inputs, two nodes: the local search ends at a radius of 1.097 from every start."""
    A = [
        [0.66, 0.146, 0.179, 0, 0, 0],
        [0.146, 0.836, 0, 0, 0, 0],
        [0.179, 0, 0.572, 0.089, 0.15, 0],
        [0, 0, 0.089, 0.906, 0, 0],
        [0, 0, 0.15, 0, 0.678, 0.165],
        [0, 0, 0, 0, 0.165, 0.828],
    ]
    E = [[0.24, 1.14], [-0.46, 0.33], [1.22, -1.67], [-0.87, 0.58], [-1.38, 0.62], [-0.09, 1.12]]
    both = [[0, 0, 0, 0, 1, 0], [0, 0, 1, 0, 0, 0]]
    (tmp_path / "hard.yaml").write_text(
        f"name: hard\nplant: {{time: discrete, period: 1, A: {A}, E: {E}, x0: [0, 0, 0, 0, 0, 0]}}\n"
        f"observer: {{method: augmented{observer}}}\n"
        f"nodes:\n  1: {{C: {[[-1.3, -0.89, -1.99, 0.24, -1.21, 1.71], *both]}}}\n  2: {{C: {both}}}\n"
        "graph: {edges: [[1, 2]]}\nrun: {steps: 100, convergence: {rms_below: 0.1}}\n"
    )
    return load_scenario(tmp_path / "hard.yaml")


def test_lqg_is_taken_where_the_search_finds_nothing(tmp_path):
    said = []
    found = synthesise_aloud(hard(tmp_path), said.append).certificate
    assert found["gains"] == "lqg"
    assert found["gains_note"].endswith(
        "(closest: 1.097). The search is local, so this proves nothing. Those of lqg are taken."
    )
    assert any(line.startswith("gains: h2 found none; trying lqg") for line in said)
    same = synthesise(hard(tmp_path, ", gains: lqg")).certificate
    assert found["spectral_radius"] == same["spectral_radius"] < 0.95
    assert "gains_note" not in same


@pytest.mark.parametrize(
    ("observer", "advice"),
    [
        (", gains: {h2: {extra_states: 0}}", r"nothing\. Use gains: lqg, or raise h2\.starts or"),  # binding
        (", delay: 1", r"nothing\. Raise h2\.starts or"),  # lqg has no delay
        (
            ", rate: 0.05",
            r"nothing\. gains: lqg, tried next, (has the spectral radius|finds none).* Use gains: lqg with",
        ),
    ],
)
def test_what_may_help_is_said_where_h2_finds_nothing(tmp_path, observer, advice):
    with pytest.raises(DesignError, match=rf"gains: h2: no gains with a spectral radius below .* proves {advice}"):
        synthesise(hard(tmp_path, observer))


def test_the_same_file_gives_the_same_bits():
    first, second = synthesise(load("six_state")), synthesise(load("six_state", run__seed=7))
    for i, node in first.nodes.items():
        for name, M in node.matrices.items():
            assert M.tobytes() == second.nodes[i].matrices[name].tobytes()


def test_the_start_is_mild_where_a_node_barely_sees_a_direction():
    scenario = load("six_state")
    network = {i: (node.C, scenario.plant.A) for i, node in scenario.nodes.items()}
    for C, A in network.values():
        F = mild_filter(C, A)
        assert np.linalg.norm(F, 2) < 5
    assert not mild_filter(np.zeros((1, 6)), scenario.plant.A).any()


def test_too_large_is_said_before_the_search(monkeypatch):
    monkeypatch.setattr("duio_mesh.synthesis.augmented.LARGEST", 8)
    with pytest.raises(DesignError, match=r"gains exist .* has \d+ rows and is dense; .*method: lmi"):
        synthesise(load("example9"))


def test_a_riccati_equation_that_scipy_gives_up_on_costs_a_start_only(monkeypatch):
    def refuse(*_, **__):
        raise ValueError("Reordering of (A, B) failed because the transformed matrix pair is too far from Schur form")

    def quiet(**overrides):
        scenario = load("example9", **overrides)  # without the plant's own LQR gain
        return replace(scenario, plant=replace(scenario.plant, control=OpenLoop(((),) * scenario.plant.B.shape[1])))

    monkeypatch.setattr(linalg, "solve_discrete_are", refuse)
    assert synthesise(quiet()).certificate["spectral_radius"] < 1
    with pytest.raises(DesignError, match="no compensator at one of the nodes"):
        synthesise(quiet(observer__gains="lqg"))
