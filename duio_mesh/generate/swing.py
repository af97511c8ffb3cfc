"""Linearised swing equations of an IEEE test case (plants for seed 004's observer, and sampled for seed 001's)."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from math import ceil
from typing import Any, NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import ScenarioError
from duio_mesh.generate.document import Document, rows
from duio_mesh.generate.graphs import edges
from duio_mesh.generate.sampling import zero_order_hold

STEP = 0.01  # s
FREQUENCY = 60.0  # Hz
MOST_LOADS = 3
NOISE = 1e-3  # rad and rad/s, standard deviation
METHODS = ("reduced_order", "augmented")


class Machine(NamedTuple):
    """On the machine's own base."""

    rating: float  # MVA
    inertia: float  # H in s
    reactance: float  # x'd, per unit
    damping: float  # D, per unit of torque per unit of speed


def _system_base(inertia: float, reactance: float, damping: float) -> Machine:
    return Machine(100.0, inertia, reactance, damping)


# Of the published dynamic data of both cases, from memory (the cases themselves hold none): rounded, typical values.
MACHINES: dict[int, dict[int, Machine]] = {
    14: {
        1: Machine(615, 5.148, 0.2995, 2),
        2: Machine(60, 6.54, 0.185, 2),
        3: Machine(60, 6.54, 0.185, 2),
        6: Machine(25, 5.06, 0.232, 2),
        8: Machine(25, 5.06, 0.232, 2),
    },
    39: {
        30: _system_base(42.0, 0.0310, 10),
        31: _system_base(30.3, 0.0697, 10),
        32: _system_base(35.8, 0.0531, 10),
        33: _system_base(28.6, 0.0436, 10),
        34: _system_base(26.0, 0.1320, 10),
        35: _system_base(34.8, 0.0500, 10),
        36: _system_base(26.4, 0.0490, 10),
        37: _system_base(24.3, 0.0570, 10),
        38: _system_base(34.5, 0.0570, 10),
        39: _system_base(500.0, 0.0060, 10),
    },
}

INFINITE = {14: 1, 39: 39}
"""The machine whose angle is the reference: by far the largest one, in case 39 the rest of the interconnection."""


@dataclass(frozen=True)
class Swing:
    """The parameters; ``document`` raises ScenarioError when they make no sense."""

    case: int
    nodes: int | None = None
    loads: int = 1
    graph: str = "ring"
    method: str = "reduced_order"
    seed: int = 0


class Grid(NamedTuple):
    """dx/dt = A x + B p_mech + E p_load, x = angles and speeds of ``machines`` against the infinite bus ``slack``."""

    A: Array  # (2 g, 2 g)
    B: Array  # (2 g, g), one column per machine
    E: Array  # (2 g, number of buses), one column per bus
    machines: list[int]  # bus numbers
    slack: int
    buses: list[int]  # bus numbers of the columns of E
    loads: dict[int, float]  # MW at the buses that have a load


def document(p: Swing) -> Document:
    """The topology of an IEEE case. Raises ScenarioError without PYPOWER and for parameters that make no sense."""
    grid = linearised(p.case)
    g = len(grid.machines)
    N = g if p.nodes is None else p.nodes
    _check(p, g, N)
    unmetered = _largest_loads(grid, p.loads)
    driven = sorted(np.argsort(np.diag(grid.B[g:]))[-2:])  # the lightest machines answer most
    names = [f"p_mech{grid.machines[k]}" for k in driven]
    A, B, E = grid.A, grid.B[:, driven], grid.E[:, [grid.buses.index(bus) for bus in unmetered]]
    time: dict[str, Any] = {"time": "continuous"}
    if p.method == "augmented":
        A, held = zero_order_hold(A, np.hstack([B, E]), STEP)
        B, E, time = held[:, : len(names)], held[:, len(names) :], {"time": "discrete", "period": STEP}
    content = {
        "name": f"swing-{p.case}-{N}-{p.graph}" + ("-sampled" if p.method == "augmented" else ""),
        "description": f"Swing equations of the IEEE {p.case} bus system and {N} observers on a {p.graph} graph",
        "plant": {
            **time,
            "A": A,
            "B": B,
            "inputs": names,
            "E": E,
            "x0": {"normal": {"mean": 0, "std": 0.1}},
            "control": {"signals": {name: {"sine": {"amplitude": 0.1, "rate": 0.9}} for name in names}},
            "disturbance": [_demand(grid.loads[bus] / 100, k) for k, bus in enumerate(unmetered)],
            **({"noise": {"std": NOISE}} if p.method == "augmented" else {}),
        },
        "observer": {"method": "augmented"} if p.method == "augmented" else {"method": p.method, "hold": "quadratic"},
        "nodes": {i: {"C": _sensors(grid, _seen(grid, E, i, N)), "knows": names} for i in range(1, N + 1)},
        "graph": {"edges": edges(p.graph, N, np.random.default_rng(p.seed))},
        "run": {
            **({"step": STEP} if p.method == "reduced_order" else {}),
            "steps": 1500,
            "seed": 0,
            "convergence": {"rms_below": 0.01, "over_last": 0.3},
        },
    }
    return Document(content, _heading(p, grid, unmetered), _comments(p, grid))


def _check(p: Swing, g: int, N: int) -> None:
    problems = []
    if not 1 <= N <= g:
        problems.append(f"--nodes: should be between 1 and {g}, the machines beside the infinite bus, not {N}")
    if not 1 <= p.loads <= MOST_LOADS:
        problems.append(f"--loads: should be between 1 and {MOST_LOADS}, not {p.loads}")
    elif not problems and N * p.loads < g:
        problems.append(
            f"--nodes: should be at least {ceil(g / p.loads)}, not {N}: a node measures as many machines as there are "
            f"unmetered loads ({p.loads}), and somebody must measure each of the {g} machines"
        )
    if problems:
        raise ScenarioError(problems)


def _largest_loads(grid: Grid, q: int) -> list[int]:
    """The buses of the q largest loads that stand at no machine."""
    free = [bus for bus in grid.loads if bus not in (*grid.machines, grid.slack)]
    return sorted(sorted(free, key=lambda bus: -grid.loads[bus])[:q])


def _demand(size: float, k: int) -> list[dict[str, dict[str, float]]]:
    """What the (k + 1)-th unmetered load of ``size`` per unit does: a tenth of it swings, a twentieth comes on."""
    sine = {"amplitude": round(0.1 * size, 3), "rate": round(1.3 + 0.4 * k, 1), "phase": 0.3}
    return [{"sine": sine}, {"step": {"time": 10, "after": round(0.05 * size, 3)}}]


def _seen(grid: Grid, E: Array, i: int, N: int) -> list[int]:
    """The machines, counted from 0, that node i measures: i, i + N, ..., in all as many as there are loads.

    With fewer it could not tell the loads apart; with more it would see a little of the other machines by itself, too
    little for a gain of sensible size (norms of 1e3 to 1e7 on case 39). A load reaches a machine's speed first, so
    these rows of E must have full column rank (Assumption 2): each machine more is the one that raises the least
    singular value of the rows, taken with length 1, most.
    """
    g = len(grid.machines)
    felt = E[g:] / np.linalg.norm(E[g:], axis=1, keepdims=True)
    seen = list(range(i - 1, g, N))

    def apart(k: int) -> float:
        sigma = np.linalg.svd(felt[[*seen, k]], compute_uv=False)
        return float(sigma[min(len(seen) + 1, E.shape[1]) - 1])

    while len(seen) < E.shape[1]:
        seen.append(max((k for k in range(g) if k not in seen), key=apart))
    return sorted(seen)


def _sensors(grid: Grid, seen: list[int]) -> Array:
    """Angle and speed of each of these machines."""
    g = len(grid.machines)
    return rows(2 * g, *seen, *(g + k for k in seen))


def _heading(p: Swing, grid: Grid, unmetered: list[int]) -> str:
    at = ", ".join(map(str, unmetered))
    return f"""
        Swing equations of the IEEE {p.case} bus system, linearised and without losses, machine {grid.slack} as infinite
        bus; nobody meters the load at {"bus" if len(unmetered) == 1 else "buses"} {at}. Branches and loads are those of
        PYPOWER's case{p.case}, which holds no dynamic data: inertias, transient reactances and damping are rounded
        values of the published data, from memory (duio_mesh/generate/swing.py).
    """


def _comments(p: Swing, grid: Grid) -> dict[tuple[str | int, ...], str]:
    sampled = f", sampled exactly every {STEP:g} s" if p.method == "augmented" else ""
    observer = {
        "reduced_order": "Every node also reconstructs the loads that nobody meters.",
        "augmented": "All gains are designed together.",
    }
    return {
        ("plant", "A"): f"""
            x: rotor angles of machines {", ".join(map(str, grid.machines))} (rad), then their speeds (rad/s),
            both against the infinite bus{sampled}. The network is reduced to the machines' inner buses.
        """,
        ("plant", "B"): "u: mechanical power per unit of 100 MVA of the machines in inputs; every node is told.",
        ("plant", "E"): "w: power drawn by the unmetered loads per unit of 100 MVA, split by electrical distance.",
        ("plant", "disturbance"): "a tenth of each load swings, and at 10 s a twentieth of it is switched on",
        ("observer",): observer[p.method],
        (
            "nodes",
        ): "Angles, then speeds, of the machines that a node measures; together the nodes measure all of them.",
        ("run", "convergence"): "rad and rad/s",
    }


def case_data(case: int) -> dict[str, Any]:
    """PYPOWER's case. Raises ScenarioError when the package is not installed."""
    try:
        module = importlib.import_module(f"pypower.case{case}")
    except ImportError:
        raise ScenarioError(
            ["swing: the cases come with the package PYPOWER, which is not installed: pip install 'duio_mesh[grid]'"]
        ) from None
    data: dict[str, Any] = getattr(module, f"case{case}")()
    return data


def linearised(case: int) -> Grid:
    """The lossless swing equations at zero power flow, with the loads eliminated.

    M_i d2 delta_i/dt2 = p_i - D_i d delta_i/dt - sum_j K_ij (delta_i - delta_j), M = 2 H / (2 pi f), all per unit of
    100 MVA. K is the DC power flow's Laplacian (1 / (tap x) of every branch in service, and each machine behind its
    x'd), Kron-reduced to the machines' inner buses; power drawn at a bus reaches the machines as the reduction says.
    """
    data, known = case_data(case), MACHINES[case]
    base = float(data["baseMVA"])
    buses = [int(b) for b in data["bus"][:, 0]]
    at = {bus: k for k, bus in enumerate(buses)}
    g, n = len(known), len(known) + len(buses)
    L = np.zeros((n, n))

    def connect(i: int, j: int, x: float) -> None:
        L[[i, j], [i, j]] += 1 / x
        L[[i, j], [j, i]] -= 1 / x

    for k, (bus, machine) in enumerate(known.items()):
        connect(k, g + at[bus], machine.reactance * base / machine.rating)
    for branch in data["branch"]:
        if branch[10] == 1:  # in service
            connect(g + at[int(branch[0])], g + at[int(branch[1])], float(branch[3]) * (float(branch[8]) or 1.0))
    share = -np.linalg.solve(L[g:, g:], L[g:, :g]).T  # of the power drawn at a bus, on each machine
    K = L[:g, :g] - share @ L[g:, g:] @ share.T
    slack = INFINITE[case]
    keep = [k for k, bus in enumerate(known) if bus != slack]
    scale = [m.rating / base for m in known.values()]
    M = np.array([2 * m.inertia * s / (2 * np.pi * FREQUENCY) for m, s in zip(known.values(), scale, strict=True)])
    D = np.array([m.damping * s / (2 * np.pi * FREQUENCY) for m, s in zip(known.values(), scale, strict=True)])
    zero, unit, inverse = np.zeros((len(keep), len(keep))), np.eye(len(keep)), np.diag(1 / M[keep])
    A = np.block([[zero, unit], [-inverse @ K[np.ix_(keep, keep)], -inverse @ np.diag(D[keep])]])
    return Grid(
        A,
        np.vstack([zero, inverse]),
        np.vstack([np.zeros((len(keep), len(buses))), -inverse @ share[keep]]),
        [bus for bus in known if bus != slack],
        slack,
        buses,
        {int(row[0]): float(row[2]) for row in data["bus"] if row[2] > 0},
    )
