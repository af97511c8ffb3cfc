"""Generated files load, are designed, converge, and hold the system that their comments describe."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from pypower.makeBdc import makeBdc
from scipy import integrate, linalg

from duio_mesh.arrays import Array
from duio_mesh.cli import main
from duio_mesh.errors import DesignError
from duio_mesh.generate import swing
from duio_mesh.report.metrics import converged
from duio_mesh.scenario import load_scenario
from duio_mesh.scenario.model import Scenario
from duio_mesh.simulation import simulate
from duio_mesh.synthesis import options_of, synthesise
from duio_mesh.synthesis.admm import island_of
from duio_mesh.synthesis.admm_local import local_estimates
from duio_mesh.synthesis.admm_rates import iterates, worst_error


def made(order: str, *overrides: str) -> Scenario:
    """The scenario of `launch.py new ORDER`."""
    path = Path(f"{order.replace(' ', '_')}.yaml")
    assert main(["new", *order.split(), "--out", str(path)]) == 0
    return load_scenario(path, overrides, options_of=options_of)


@pytest.mark.parametrize(
    "order",
    [
        "heat --rooms 3x3 --nodes 4",
        "heat --rooms 4x4 --nodes 6 --graph random",
        "heat --rooms 4x4 --nodes 6 --graph star --own-rooms 1 --seed 3",
        "heat --rooms 3x3 --nodes 4 --graph grid --method augmented",
        "heat --rooms 1x2 --nodes 1",
        "platoon --vehicles 4",
        "platoon --vehicles 9 --graph random --seed 1",
        "swing --case 14",
        "swing --case 14 --loads 2 --nodes 3 --graph path",
        "swing --case 14 --method augmented",
        "swing --case 39 --loads 2 --nodes 5",
    ],
)
def test_is_designed_and_converges(order: str) -> None:
    s = made(order)
    assert converged(simulate(synthesise(s)), s.run.convergence)


def test_without_their_neighbours_vehicles_and_machines_do_not_manage() -> None:
    """The network is needed: each node follows itself only, machines at least the slow modes."""
    for order, more in (("platoon --vehicles 4", ()), ("swing --case 14", ("observer.sigma=0.5",))):
        with pytest.raises(DesignError):
            synthesise(made(order, "graph.edges=[]", *more))


def test_rooms_exchange_heat_with_the_rooms_next_to_them_only() -> None:
    plant = made("heat --rooms 3x4 --nodes 4 --seed 5").plant
    flow = linalg.logm(plant.A).real / plant.step
    where = [divmod(room, 4) for room in range(12)]
    for i, (row, column) in enumerate(where):
        for j, (other_row, other_column) in enumerate(where):
            distance = abs(row - other_row) + abs(column - other_column)
            if distance == 1:
                assert 5e-4 - 1e-9 < flow[i, j] < 40e-4 + 1e-9
            elif distance > 1:
                assert abs(flow[i, j]) < 1e-12
    assert plant.A.sum(axis=0) == pytest.approx(1)  # no heat is lost,
    assert plant.A.sum(axis=1) == pytest.approx(1)  # and rooms at the same temperature keep it
    heat = np.hstack([plant.B, plant.E]).sum(axis=0)
    assert heat == pytest.approx(0.003 * 60)  # what comes in stays in


def test_every_node_of_a_building_sees_what_it_is_not_told() -> None:
    s = made("heat --rooms 5x5 --nodes 7 --hvac 3 --own-rooms 2")
    for i, node in s.nodes.items():
        unknown = s.unknown(i)
        assert len(node.knows) == 1
        assert node.C.shape == (3 + 2, 25)
        assert np.linalg.matrix_rank(node.C) == 5
        assert np.linalg.matrix_rank(node.C @ unknown) == unknown.shape[1] == 3
    assert {node.knows[0] for node in s.nodes.values()} == set(s.plant.inputs)


def test_vehicles_move_as_newton_says() -> None:
    plant = made("platoon --vehicles 3 --seed 2").plant
    drag = -np.log(np.diag(plant.A)[1::2]) / plant.step
    assert np.all((drag > 0.02) & (drag < 0.06))
    x, a, w = np.array([1.0, 2, -1, 3, 0.5, -2]), np.array([0.3, -1, 2]), 0.7

    def rate(_: float, now: Array) -> Array:
        force = a + np.array([w, 0, 0]) - drag * now[1::2]
        return np.column_stack([now[1::2], force]).ravel()

    after = integrate.solve_ivp(rate, (0, plant.step), x, rtol=1e-11, atol=1e-12).y[:, -1]
    assert plant.A @ x + plant.B @ a + plant.E[:, 0] * w == pytest.approx(after, abs=1e-10)


def test_where_exact_fusion_would_lose_digits_admm_has_iterations_enough() -> None:
    """Worst error 1e-3 of a state of norm 1: far below the noise of vehicles that stay within metres."""
    s = made("platoon --vehicles 32 --graph random")
    assert s.options.fusion == "admm"
    island = island_of(s, tuple(s.nodes), local_estimates(s, s.options))
    *_, last = islice(iterates(island, s.options), s.options.nu)
    assert worst_error(last) < 1e-3
    exact = s.options.model_copy(update={"fusion": "finite_time"})
    *_, last = iterates(island, exact)
    assert worst_error(last) > 1e-6  # what the design refuses
    assert made("platoon --vehicles 32").options.fusion == "finite_time"


@pytest.mark.parametrize("case", [14, 39])
def test_machines_accelerate_by_the_power_that_the_network_does_not_take(case: int) -> None:
    """The swing equation with PYPOWER's own DC power flow matrix and all buses kept, for random states and loads."""
    grid = swing.linearised(case)
    data, machines = swing.case_data(case), swing.MACHINES[case]
    bus, branch = data["bus"].copy(), data["branch"].copy()
    bus[:, 0] -= 1
    branch[:, :2] -= 1
    B = makeBdc(data["baseMVA"], bus, branch)[0].toarray()
    rng = np.random.default_rng(0)
    g = len(grid.machines)
    angle, speed, power = rng.normal(size=(3, g))
    demand = rng.normal(size=len(bus))
    rotor = dict(zip(grid.machines, angle, strict=True)) | {grid.slack: 0.0}
    y = {at: m.rating / 100 / m.reactance for at, m in machines.items()}
    for at in machines:
        B[at - 1, at - 1] += y[at]
    injected = -demand
    for at in machines:
        injected[at - 1] += y[at] * rotor[at]
    theta = np.linalg.solve(B, injected)
    synchronous = 2 * np.pi * 60
    expected = []
    for k, at in enumerate(grid.machines):
        m = machines[at]
        taken = y[at] * (rotor[at] - theta[at - 1]) + m.damping * m.rating / 100 * speed[k] / synchronous
        expected.append((power[k] - taken) * synchronous / (2 * m.inertia * m.rating / 100))
    rate = grid.A @ np.concatenate([angle, speed]) + grid.B @ power + grid.E @ demand
    assert rate[:g] == pytest.approx(speed)
    assert rate[g:] == pytest.approx(expected, rel=1e-9)


def test_a_sampled_grid_is_the_continuous_one() -> None:
    slow, sampled = made("swing --case 14").plant, made("swing --case 14 --method augmented").plant
    x, u, w = np.linspace(-1, 1, 8), np.array([0.2, -0.1]), np.array([0.3])
    after = integrate.solve_ivp(
        lambda _, now: slow.A @ now + slow.B @ u + slow.E @ w, (0, sampled.step), x, rtol=1e-11, atol=1e-12
    ).y[:, -1]
    assert sampled.A @ x + sampled.B @ u + sampled.E @ w == pytest.approx(after, abs=1e-9)
    assert slow.inputs == sampled.inputs


@pytest.mark.parametrize(("loads", "nodes"), [(1, 9), (2, 5), (3, 3), (3, 8)])
def test_all_machines_are_measured_and_every_node_can_tell_the_loads_apart(loads: int, nodes: int) -> None:
    s = made(f"swing --case 39 --loads {loads} --nodes {nodes}")
    seen = np.vstack([node.C for node in s.nodes.values()])
    assert np.linalg.matrix_rank(seen) == 18
    for node in s.nodes.values():
        assert node.C.shape == (2 * loads, 18)
        sigma = np.linalg.svd(node.C @ s.plant.E, compute_uv=False)
        assert sigma[-1] > 1e-3 * sigma[0]
