"""A continuous plant's exact propagation against an independent ODE solver, and its sampling."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from duio_mesh.dynamics import Plant, signals
from duio_mesh.errors import DesignError
from duio_mesh.scenario import model
from duio_mesh.synthesis.design import plant_spec

A = np.array([[0.0, 1.0, 0.2], [-9.0, -0.4, 0.5], [0.3, -0.2, 0.1]])
B = np.array([[0.0, 0.3], [1.0, 0.0], [0.0, 1.0]])
E = np.array([[0.2], [0.0], [-1.0]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def wave(kind, amplitude=1.0, period=1.0, phase=0.0):
    return {kind: {"amplitude": amplitude, "period": period, "phase": phase}}


def step(time, before=0.0, after=1.0):
    return {"step": {"before": before, "after": after, "time": time}}


def constant(value):
    return {"constant": {"value": value}}


SINES = (wave("sine", 1.5, 2.0, 0.3), wave("cosine", -0.7, 2.0, 1.1), wave("sine", 0.4, 0.33))
SWITCHES = (wave("square", 2.0, 0.37, 0.4), step(0.413, -1.0, 3.0), step(0.42), constant(0.5))


QUIET = model.OpenLoop(((), ()))
NO_NOISE = (np.zeros((2, 0)), ())
NO_FEEDBACK = np.zeros((2, 3))


def scenario(control=QUIET, disturbance=((),), h=0.05, steps=40, noise=NO_NOISE):
    plant = model.Plant("continuous", h, A, B, E, ("a", "b"), np.array([1, -2, 0.5]), control, disturbance)
    node = model.Node(1, C, ("b",), model.Noise(*noise))
    run = model.Run(steps, 7, model.Convergence(1.0, 0.5), 5.0, 8)
    return model.Scenario("test", "", plant, "lmi", None, {1: node}, model.Graph((1,), (), False), run, {})


def sampled(spec):
    """x(k), y(k), u(k) for k = 0 .. steps - 1."""
    plant, x, y, u = Plant(spec), [], [], []
    for _ in range(spec.steps):
        data = plant.sample()[1]
        x.append(plant.x), y.append(data[:2]), u.append(plant.u)
        assert data[2:] == plant.u[1:]  # node 1 is told input b only
        plant.advance()
    return np.array(x), np.array(y), np.array(u)


def integrated(x0, drive, times, cuts=(), F=NO_FEEDBACK):
    """x at ``times`` from an ODE solver that never steps across a cut; drive(t) is [u; w]."""
    G = np.hstack([B, E])
    x, t, found = np.array(x0, dtype=float), 0.0, [np.array(x0, dtype=float)]
    for end in times[1:]:
        inner = [c for c in cuts if t + 1e-12 < c < end - 1e-12]
        for to in [*sorted(inner), end]:
            middle = (t + to) / 2  # switching parts are taken in the middle of the piece, smooth ones where asked
            rhs = lambda s, v, m=middle: (A + B @ F) @ v + G @ drive(s, m)  # noqa: E731
            x = solve_ivp(rhs, (t, to), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
            t = to
        found.append(x)
    return np.array(found)


def test_sinusoids_constants_and_switches_inside_ticks_are_exact():
    control = model.OpenLoop(((*SINES, constant(-1.0)), (step(1.01, 0.0, 2.0),)))
    spec = plant_spec(scenario(control, (SWITCHES,)))
    x, y, u = sampled(spec)
    switching = [0.413, 0.42, 1.01, *((m * math.pi - 0.4) / (2 * math.pi) * 0.37 for m in range(40))]

    def drive(t, middle):
        smooth = signals([SINES], t, None)[0] - 1.0
        return np.array([smooth, *signals([(step(1.01, 0.0, 2.0),), SWITCHES], middle, None)])

    times = np.arange(40) * 0.05
    expected = integrated((1, -2, 0.5), drive, times, switching)
    np.testing.assert_allclose(x, expected, rtol=0, atol=2e-10)
    np.testing.assert_array_equal(y, np.array([C @ v for v in x]))
    np.testing.assert_allclose(u, [signals(control.signals, t, None) for t in times], rtol=0, atol=1e-14)
    assert spec.matrices["switch_ticks"].size >= 10  # the test would be empty if nothing switched inside a tick


def test_a_switch_on_the_sampling_grid_is_the_same_at_every_rate():
    """Square and step switch exactly at samples, where sin() rounds to either sign: coarse and fine sampling agree."""
    drives = ((wave("square", 1.0, 0.6), step(0.9, 0.0, -2.0)),)
    coarse, _, _ = sampled(plant_spec(scenario(disturbance=drives, h=0.1, steps=31)))
    fine, _, _ = sampled(plant_spec(scenario(disturbance=drives, h=0.0125, steps=241)))
    np.testing.assert_allclose(coarse, fine[::8], rtol=0, atol=1e-12)


def test_feedback_acts_continuously():
    F, reference = np.array([[-3.0, -1.0, 0.0], [0.0, 0.0, -2.0]]), np.array([1.0, 0.0, -1.0])
    spec = plant_spec(scenario(model.Feedback(F, reference), ((wave("sine", 1.0, 1.3),),)))
    x, _, u = sampled(spec)
    drive = lambda t, _: np.array([*(-F @ reference), math.sin(2 * math.pi * t / 1.3)])  # noqa: E731
    np.testing.assert_allclose(x, integrated((1, -2, 0.5), drive, np.arange(40) * 0.05, F=F), rtol=0, atol=2e-10)
    np.testing.assert_allclose(u, (x - reference) @ F.T, rtol=0, atol=1e-13)


def test_lqr_of_a_continuous_plant_settles_at_its_reference():
    weights = model.Lqr(np.eye(3), np.eye(2), np.zeros(3))
    x, _, _ = sampled(plant_spec(scenario(weights, h=0.1, steps=150)))
    assert np.abs(x[-1]).max() < 1e-3 < np.abs(x[0]).max()


def test_normal_signals_are_held_over_a_tick():
    normal = {"normal": {"mean": 0.5, "std": 2.0}}
    spec = plant_spec(scenario(model.OpenLoop(((normal,), ())), ((wave("sine"), normal),), steps=12))
    x, _, u = sampled(spec)
    draws = np.random.default_rng([7, 2])  # the plant's stream for the disturbance
    w = [0.5 + 2.0 * draws.standard_normal() for _ in range(12)]
    at = lambda t: int(t / 0.05)  # noqa: E731
    drive = lambda t, m: np.array([*u[at(m)], math.sin(2 * math.pi * t) + w[at(m)]])  # noqa: E731
    np.testing.assert_allclose(x, integrated((1, -2, 0.5), drive, np.arange(12) * 0.05), rtol=0, atol=2e-10)
    assert np.std(u[:, 0]) > 0.5


def test_sensor_noise_is_drawn_per_tick_through_its_channel():
    channel = np.array([[2.0], [-1.0]])
    noisy = scenario(noise=(channel, (({"normal": {"mean": 0.0, "std": 1.0}},),)))
    x, y, _ = sampled(plant_spec(noisy))
    v = (y - x @ C.T) / channel.T
    np.testing.assert_allclose(v[:, 0], v[:, 1], atol=1e-12)
    assert 0.5 < np.std(v[:, 0]) < 1.5
    again, _, _ = sampled(plant_spec(noisy))
    np.testing.assert_array_equal(x, again)


def test_a_discrete_plant_is_its_plain_recursion_bit_for_bit():
    base = scenario(model.OpenLoop(((wave("sine"),), (step(0.3),))), ((*SWITCHES, {"normal": {"mean": 0, "std": 1}}),))
    spec = plant_spec(dataclasses.replace(base, plant=dataclasses.replace(base.plant, time="discrete")))
    assert set(spec.matrices) == {"A", "B", "E"}
    x, _, u = sampled(spec)
    expected, draws = x[0], np.random.default_rng([7, 2])
    for k in range(39):
        expected = A @ expected + B @ u[k] + E @ signals(spec.disturbance, k * 0.05, draws)
        np.testing.assert_array_equal(x[k + 1], expected)


def test_a_square_wave_far_faster_than_the_sampling_is_refused():
    with pytest.raises(DesignError, match="switches inside a tick more than 20000 times"):
        plant_spec(scenario(disturbance=((wave("square", 1.0, 5e-5),),)))
