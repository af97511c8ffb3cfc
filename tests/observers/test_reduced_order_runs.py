"""Seed 004 on its two power systems: the accuracy of the notes, and the message form against a stacked recursion."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.dynamics import Plant, signals
from duio_mesh.synthesis.reduced_order_local import Model, interval, separate, split

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def load(name, **overrides):
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario(TOPOLOGIES / f"reduced_order_{name}.yaml", **dotted)


def unknown_input(scenario, t):
    return np.array([signals(scenario.plant.disturbance, s, None) for s in t])


def measured(design):
    """{node: (K, p)} and u (K, m) as the plant sends them."""
    plant, data, u = Plant(design.plant), [], []
    for _ in range(design.plant.steps):
        data.append(plant.sample())
        u.append(plant.u)
        plant.advance()
    return {i: np.array([d[i][: spec.p] for d in data]) for i, spec in design.nodes.items()}, np.array(u)


@pytest.mark.parametrize(
    ("name", "hold", "worst"),
    [
        ("kundur8", "first_order", (8e-3, 0.14, 1e-3)),
        ("newengland18", "first_order", (6e-3, 0.12, 1e-3)),
        ("kundur8", "quadratic", (3e-4, 1e-2, 1e-4)),
        ("newengland18", "quadratic", (3e-4, 1e-2, 1e-4)),
    ],
)
def test_state_unknown_input_and_noise_errors_at_10_ms(name, hold, worst):
    scenario = load(name, observer__hold=hold, run__steps=1000)
    design = synthesise(scenario)
    trace = simulate(design)
    late = (trace.t >= 7) & (trace.t < 10)
    assert np.abs(trace.xhat - trace.x)[:, late].max() <= worst[0]
    assert np.abs(trace.what - unknown_input(scenario, trace.t))[:, late].max() <= worst[1]
    y, _ = measured(design)
    for i, node in scenario.nodes.items():
        v = (y[i] - trace.x @ node.C.T) @ np.linalg.pinv(node.noise.channel).T  # the noise that was drawn
        assert np.abs(v).max() > 1
        assert np.abs(trace.vhat[i] - v)[late].max() <= worst[2]


def test_zero_order_hold_costs_two_orders_of_magnitude():
    coarse, smooth = (
        simulate(synthesise(load("kundur8", observer__hold=hold, run__steps=800)))
        for hold in ("zero_order", "first_order")
    )
    errors = [np.abs(trace.xhat - trace.x)[:, 600:].max() for trace in (coarse, smooth)]
    assert errors[0] > 50 * errors[1]


def test_noise_inside_its_channel_changes_neither_state_nor_unknown_input():
    noisy, quiet = load("kundur8", run__steps=300), load("kundur8", run__steps=300)
    silent = {
        i: dataclasses.replace(node, noise=node.noise._replace(signals=((),) * len(node.noise.signals)))
        for i, node in quiet.nodes.items()
    }
    a, b = simulate(synthesise(noisy)), simulate(synthesise(dataclasses.replace(quiet, nodes=silent)))
    np.testing.assert_allclose(a.xhat, b.xhat, rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.what, b.what, rtol=0, atol=1e-10)
    assert np.abs(a.vhat[2] - b.vhat[2]).max() > 1


def test_a_step_of_the_unknown_input_is_tracked_within_a_tenth_of_a_second():
    jump = [[{"step": {"time": 4.0, "before": -1.0, "after": 1.0}}]]
    trace = simulate(synthesise(load("kundur8", plant__disturbance=jump, run__steps=500)))
    before, after = (trace.t > 3.5) & (trace.t < 4.0), trace.t >= 4.1
    assert np.abs(trace.what[:, before] + 1).max() < 0.02
    assert np.abs(trace.what[:, after] - 1).max() < 0.05


def test_a_plain_known_input_that_is_held_per_tick_wants_its_own_hold():
    """A normal signal is held over a tick: interpolating it linearly is wrong, input_hold says so."""
    drawn = {"p_mech1": [{"normal": {"mean": 0.0, "std": 1.0}}]}
    errors = []
    for hold in ("quadratic", "zero_order"):
        design = synthesise(load("kundur8", plant__control__signals=drawn, observer__input_hold=hold, run__steps=600))
        trace = simulate(design)
        errors.append(np.abs(trace.xhat - trace.x)[:, 450:].max())
    assert errors[1] < 0.2 * errors[0]


class Stacked:
    """All nodes as one system, straight from (6)-(15): dS/dt = F S + Y y + U u + bias + coupling frozen per tick."""

    def __init__(self, scenario, c):
        options, graph = scenario.options, scenario.graph
        D, n = scenario.plant.E, scenario.plant.n
        q, N = D.shape[1], len(scenario.nodes)
        low, high = -5 * np.ones(q), 5 * np.ones(q)
        F, Y, U, bias, X, Xy, T = [], [], [], [], [], [], []
        self.alpha = []
        for i, node in scenario.nodes.items():
            model = Model(scenario.plant.A, scenario.known(i), D, node.C, node.noise.channel)
            s = separate(model, "", ())
            g, b = split(s, 0.5, 3.0, ""), interval(s, low, high)
            z1 = np.linalg.inv(s.C11) @ s.W1
            kappa = options.kappa * np.eye(q)
            F.append(np.block([[s.A22 - g.N @ s.C22, np.zeros((n - q, q))], [b.Phi, -kappa]]))
            Y.append(np.vstack([s.A21 @ z1 + g.N @ s.W2, (b.Psi + kappa) @ s.W1]))
            U.append(np.vstack([s.B2, b.Bw]))
            bias.append(np.concatenate([np.zeros(n - q), b.p_plus]))
            X.append(np.hstack([s.V2, np.zeros((n, q))]))
            Xy.append(s.U1 @ z1)
            T.append(np.vstack([g.Tu @ g.Tu.T @ s.V2.T, np.zeros((q, n))]))
            self.alpha.append((s.W1, b.width / options.kappa))
        F, Y, self.X, self.Xy, T = (linalg.block_diag(*blocks) for blocks in (F, Y, X, Xy, T))
        U, bias = np.vstack(U), np.concatenate(bias)
        coupling = -c * T @ np.kron(graph.laplacian(), np.eye(n))
        k, p, m, w = F.shape[0], Y.shape[1], U.shape[1], n * N
        # [S; y; y'; y''; u; u'; u''; x-hat of the last tick; 1], all but S known polynomials of time
        big = np.zeros((k + 3 * p + 3 * m + w + 1,) * 2)
        big[:k] = np.hstack([F, Y, np.zeros((k, 2 * p)), U, np.zeros((k, 2 * m)), coupling, bias[:, None]])
        big[k : k + 2 * p, k + p : k + 3 * p] = np.eye(2 * p)
        at = k + 3 * p
        big[at : at + 2 * m, at + m : at + 3 * m] = np.eye(2 * m)
        self.flow = linalg.expm(big * scenario.plant.step)[:k]
        self.h, self.n, self.q, self.N = scenario.plant.step, n, q, N

    def run(self, y, u):
        """x-hat (N, K, n) for y (K, sum p) and u (K, m)."""
        k = self.X.shape[1] // self.N
        S = np.zeros((self.N, k))
        offset = 0
        for row, (W1, width) in zip(S, self.alpha, strict=True):
            row[k - self.q :] = W1 @ y[0][offset : offset + W1.shape[1]] + width / 2
            offset += W1.shape[1]
        S = S.ravel()
        found = [self.X @ S + self.Xy @ y[0]]
        for at in range(1, len(y)):
            jets = [*self.jets(y[: at + 1]), *self.jets(u[: at + 1])]
            S = self.flow @ np.concatenate([S, *jets, found[-1], [1.0]])
            found.append(self.X @ S + self.Xy @ y[at])
        return np.array(found).reshape(len(y), self.N, self.n).transpose(1, 0, 2)

    def jets(self, v):
        """Value, first and second derivative at the last tick but one of the parabola through the last three."""
        if len(v) < 3:
            return v[-2], (v[-1] - v[-2]) / self.h, np.zeros_like(v[-1])
        second = (v[-1] - 2 * v[-2] + v[-3]) / self.h**2
        return v[-2], (v[-1] - v[-3]) / (2 * self.h), second


@pytest.mark.parametrize("name", ["kundur8", "newengland18"])
def test_message_form_equals_the_stacked_recursion(name):
    scenario = load(name, run__steps=300, observer__hold="quadratic")
    design = synthesise(scenario)
    y, u = measured(design)
    expected = Stacked(scenario, design.certificate["c"]).run(np.hstack(list(y.values())), u)
    np.testing.assert_allclose(simulate(design).xhat, expected, rtol=0, atol=1e-10)


def test_a_missing_message_leaves_that_edge_out_of_one_tick():
    from duio_mesh.observers import make_observer

    design = synthesise(load("newengland18", run__steps=3))
    spec = design.nodes[1]
    y, u = np.ones(spec.p), np.ones(spec.m)
    heard = {2: np.full(18, 3.0), 6: np.full(18, -2.0)}
    found = {}
    for received in ({2: heard[2]}, {6: heard[6]}, {}, heard):
        observer = make_observer(spec)
        observer.sample(y, u)
        observer.message(0)
        observer.exchange(0, received)
        observer.sample(y, u)
        found[tuple(received)] = observer.estimate().state
    alone = found[()]
    np.testing.assert_allclose(found[2, 6] - alone, found[2,] - alone + found[6,] - alone, atol=1e-12)
    assert np.abs(found[2,] - alone).max() > 1e-3
