"""Seed 003 on samples: errors, their order in the step, and the message form against a stacked recursion."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import linalg

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.dynamics import Plant
from duio_mesh.observers import make_observer
from duio_mesh.synthesis.geometric_local import local_uio

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def load(name, **overrides):
    dotted = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario(TOPOLOGIES / f"geometric_{name}.yaml", **dotted)


def tail(name, step=0.005, **overrides):
    """The largest |e_i| (2-norm) of any node between 11 and 15 s."""
    trace = simulate(synthesise(load(name, run__step=step, run__steps=round(15 / step) + 1, **overrides)))
    return np.linalg.norm(trace.xhat - trace.x, axis=2)[:, trace.t >= 11].max()


def test_centralised_error_is_below_a_millionth_of_the_state_after_5_s():
    trace = simulate(synthesise(load("centralised")))
    relative = np.linalg.norm(trace.xhat[0] - trace.x, axis=1) / np.linalg.norm(trace.x, axis=1)
    assert trace.t[-1] == 5.0
    assert relative[-1] < 1e-6
    assert np.linalg.norm(trace.x[-1]) > 1e4  # the plant is unstable, so nothing absolute is asked


@pytest.mark.parametrize(("name", "most"), [("ring", 2.5e-3), ("path", 2.6e-3), ("star", 2.5e-3)])
def test_tail_error_is_small_and_halves_with_the_step(name, most):
    ten, five, two = (tail(name, step) for step in (0.01, 0.005, 0.0025))
    assert five <= most
    assert 1.6 < ten / five < 2.1
    assert 1.6 < five / two < 2.1


def test_own_damping_brings_the_path_below_the_others_limit():
    assert tail("path", observer__kappa=10) <= 2.5e-3


def test_what_the_sign_term_and_the_hold_are_worth():
    best = tail("ring")
    assert tail("ring", observer__gamma=0) > 5 * best  # no convergence: unknown inputs act inside W_g
    assert tail("ring", observer__sign="sign") > 4 * best  # chatter
    assert tail("ring", observer__hold="zero_order") > 10 * best


def stacked(scenario, design, sign):
    """x-hat (N, K, n) from global matrices: one exponential of all nodes together, coupling by the Laplacian."""
    options, n, h = scenario.options, scenario.plant.n, scenario.plant.step
    chi, L, N = design.certificate["chi"], scenario.graph.laplacian(), len(scenario.nodes)
    parts = [
        local_uio(s.C, scenario.plant.A, scenario.known(i), scenario.unknown(i), options.poles, options.kappa, "")
        for i, s in scenario.nodes.items()
    ]
    A, Y, U, K, X, F, R = (
        linalg.block_diag(*blocks)
        for blocks in zip(*((p.local.A, p.local.Y, p.local.U, p.local.K, p.X, p.F, p.R) for p in parts), strict=True)
    )
    gamma = np.concatenate([np.full(p.R.shape[0], options.gamma * (p.group == "N2")) for p in parts])
    width = np.concatenate(
        [np.full(p.R.shape[0], d * options.gamma * h) for p, d in zip(parts, np.diag(L), strict=True)]
    )
    inputs = np.hstack([Y, U])
    k, m = inputs.shape
    big = np.zeros((k + 2 * m + K.shape[1],) * 2)  # [z; v; dv/dt; push], v = [y; u] on a straight line
    big[:k] = np.hstack([A, inputs, np.zeros((k, m)), K])
    big[k : k + m, k + m : k + 2 * m] = np.eye(m)
    flow = linalg.expm(big * h)[:k]
    plant, z, push, found, before = Plant(design.plant), np.zeros(k), np.zeros(K.shape[1]), [], None
    for _ in range(design.plant.steps):
        data = plant.sample()
        y = np.concatenate([data[i][: s.C.shape[0]] for i, s in scenario.nodes.items()])
        u = np.concatenate([data[i][s.C.shape[0] :] for i, s in scenario.nodes.items()])
        v = np.concatenate([y, u])
        if before is not None:
            z = flow @ np.concatenate([z, before, (v - before) / h, push])
        before = v
        xhat = X @ z + F @ y
        a = -R @ np.kron(L, np.eye(n)) @ xhat
        push = chi * a + gamma * (np.sign(a) if sign == "sign" else np.clip(a / width, -1, 1))
        found.append(xhat)
        plant.advance()
    return np.array(found).reshape(-1, N, n).transpose(1, 0, 2)


@pytest.mark.parametrize("name", ["ring", "star", "centralised"])
@pytest.mark.parametrize("sign", ["saturation", "sign"])
def test_message_form_equals_the_stacked_recursion(name, sign):
    scenario = load(name, observer__sign=sign, observer__hold="first_order", run__steps=600)
    design = synthesise(scenario)
    trace = simulate(design)
    error = np.abs(trace.xhat - stacked(scenario, design, sign)).max(axis=(0, 2))
    assert (error / np.maximum(1, np.abs(trace.x).max(axis=1))).max() < 1e-10


def test_a_missing_message_leaves_that_edge_out_of_one_interval():
    spec = synthesise(load("ring", observer__gamma=0)).nodes[2]
    y, u, found = np.ones(spec.p), np.ones(spec.m), {}
    heard = {1: np.full(6, 3.0), 3: np.full(6, -2.0)}
    for received in ({1: heard[1]}, {3: heard[3]}, {}, heard):
        observer = make_observer(spec)
        observer.sample(y, u)
        observer.exchange(0, received)
        observer.sample(y, u)
        found[tuple(received)] = observer.estimate().state
    alone = found[()]
    np.testing.assert_allclose(found[1, 3] - alone, found[1,] - alone + found[3,] - alone, atol=1e-12)
    assert np.abs(found[1,] - alone).max() > 1e-3
