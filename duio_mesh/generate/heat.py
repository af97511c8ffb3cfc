"""Rooms of a building: temperatures, walls, HVAC units, and heat that nobody meters (after seed 000, example 6.2)."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import ScenarioError
from duio_mesh.generate.document import Document, rows
from duio_mesh.generate.graphs import edges
from duio_mesh.generate.sampling import zero_order_hold

PERIOD = 60.0  # s
WALL = (5e-4, 40e-4)  # 1/s; the range of the walls behind the paper's matrix (topologies/plants/heat9.yaml)
HEAT = 0.003  # degrees per second and kW: a room of 50 m3 with its furniture
TARGET = 18.0  # degrees
NOISE = 0.1  # degrees, standard deviation
METHODS = ("lmi", "augmented")


@dataclass(frozen=True)
class Heat:
    """The parameters; ``document`` raises ScenarioError when they make no sense."""

    height: int
    width: int
    nodes: int
    graph: str = "ring"
    hvac: int | None = None
    own_rooms: int = 0
    method: str = "lmi"
    seed: int = 0

    @property
    def rooms(self) -> int:
        return self.height * self.width

    @property
    def units(self) -> int:
        """HVAC units: as asked for, or one per node up to four, and a room left for the disturbance."""
        return min(4, self.nodes, self.rooms - 1) if self.hvac is None else self.hvac


def document(p: Heat) -> Document:
    """The topology of a building of p.height x p.width rooms."""
    _check(p)
    rng = np.random.default_rng(p.seed)
    walls = _walls(p, rng)
    warmed, leaky = _places(p, rng)
    Ac = _laplacian(p.rooms, walls)
    A, inputs = zero_order_hold(Ac, HEAT * np.eye(p.rooms)[:, [*warmed, leaky]], PERIOD)
    B, E = inputs[:, :-1], inputs[:, -1:]
    names = [f"hvac{room + 1}" for room in warmed]
    nodes, rate = {}, 0.0
    for i in range(1, p.nodes + 1):
        told = (i - 1) % p.units
        hidden = sorted({*warmed, leaky} - {warmed[told]})
        own = _own(p, i, hidden)
        nodes[i] = {"C": rows(p.rooms, *hidden, *own), "knows": [names[told]]}
        rate = max(rate, _decay(A, np.delete(inputs, told, axis=1), hidden))
    content = {
        "name": f"heat-{p.height}x{p.width}-{p.nodes}-{p.graph}",
        "description": f"Building of {p.height} x {p.width} rooms and {p.nodes} observers on a {p.graph} graph",
        "plant": {
            "time": "discrete",
            "period": PERIOD,
            "A": A,
            "B": B,
            "inputs": names,
            "E": E,
            "x0": {"normal": {"mean": TARGET, "std": 3}},
            "control": {"lqr": {"Q": 1, "R": 0.1, "reference": [TARGET] * p.rooms}},
            "disturbance": [{"sine": {"amplitude": 2, "period": 6000}}],
            "noise": {"std": NOISE},
        },
        "observer": _observer(p),
        "nodes": nodes,
        "graph": {"edges": edges(p.graph, p.nodes, rng)},
        "run": {
            "steps": _steps(rate),
            "seed": 0,
            "convergence": {"rms_below": 2 * NOISE, "over_last": 0.5},
        },
    }
    return Document(content, _heading(p, leaky), _comments(p, leaky))


def _check(p: Heat) -> None:
    problems = []
    if p.rooms < 2:
        problems.append("--rooms: a building should have at least two rooms")
    elif not 1 <= p.units <= p.rooms - 1:
        problems.append(f"--hvac: should be between 1 and {p.rooms - 1} (one room has the heat that nobody meters)")
    elif not 0 <= p.own_rooms <= p.rooms - p.units:
        problems.append(f"--own-rooms: should be between 0 and {p.rooms - p.units}: the others are measured anyway")
    if not 1 <= p.nodes <= p.rooms:
        problems.append(f"--nodes: should be between 1 and {p.rooms}, the number of rooms, not {p.nodes}")
    if problems:
        raise ScenarioError(problems)


def _walls(p: Heat, rng: np.random.Generator) -> list[tuple[int, int, float]]:
    """(room, room, rate): neighbours in the grid, rooms counted from 0 row by row."""
    k = np.arange(p.rooms).reshape(p.height, p.width)
    pairs = [*zip(k[:, :-1].flat, k[:, 1:].flat, strict=True), *zip(k[:-1].flat, k[1:].flat, strict=True)]
    return [(int(a), int(b), float(w)) for (a, b), w in zip(pairs, rng.uniform(*WALL, len(pairs)), strict=True)]


def _laplacian(n: int, walls: list[tuple[int, int, float]]) -> Array:
    """dT/dt = A T by conduction alone; columns and rows add up to zero."""
    A = np.zeros((n, n))
    for a, b, rate in walls:
        A[a, b] += rate
        A[b, a] += rate
    return A - np.diag(A.sum(axis=1))


def _places(p: Heat, rng: np.random.Generator) -> tuple[list[int], int]:
    """Rooms with HVAC (ascending) and the room with unmetered heat: each as far as can be from those before it."""
    where = np.array([divmod(room, p.width) for room in range(p.rooms)])
    chosen = [int(rng.integers(p.rooms))]
    while len(chosen) < p.units + 1:
        far = np.min(np.abs(where[:, None] - where[chosen]).sum(axis=2), axis=1)
        chosen.append(int(np.argmax(far)))
    return sorted(chosen[1:]), chosen[0]


def _own(p: Heat, i: int, measured: list[int]) -> list[int]:
    """The rooms that node i measures for itself: the first free ones of its share of the building."""
    start = (i - 1) * p.rooms // p.nodes
    free = [(start + k) % p.rooms for k in range(p.rooms) if (start + k) % p.rooms not in measured]
    return free[: p.own_rooms]


def _decay(A: Array, unknown: Array, hidden: list[int]) -> float:
    """The largest gain per step of a node's error in the rooms that it does not measure, without any neighbour.

    ``hidden`` are the rooms that the columns of ``unknown`` heat; E = -B (C B)^-1 of seed 000, (6), with C their rows.
    """
    P = np.eye(len(A))
    P[:, hidden] -= np.linalg.solve(unknown[hidden].T, unknown.T).T
    rest = np.setdiff1d(np.arange(len(A)), hidden)
    return float(np.linalg.norm((P @ A)[np.ix_(rest, rest)], 2)) if rest.size else 0.0


def _steps(rate: float) -> int:
    """Twice the time in which an initial error of 18 degrees falls to 0.05, in whole fifties."""
    return max(100, 50 * ceil(2 * log(TARGET / 0.05) / -log(max(rate, 1e-9)) / 50))


def _observer(p: Heat) -> dict[str, str]:
    if p.method == "augmented":
        return {"method": "augmented"}
    if p.own_rooms:
        return {"method": "lmi", "decomposition": "detectability", "local_gain": "h2"}
    return {"method": "lmi", "decomposition": "observability"}


def _heading(p: Heat, leaky: int) -> str:
    return f"""
        A building of {p.height} x {p.width} rooms, {p.units} HVAC units, {p.nodes} observers (after seed 000,
        example 6.2). Heat flows through the walls between neighbouring rooms; nobody is told the heat that enters
        room {leaky + 1}.
    """


def _comments(p: Heat, leaky: int) -> dict[tuple[str | int, ...], str]:
    own = f" and {p.own_rooms} of its own" if p.own_rooms else ""
    observer = {
        "lmi": "The neighbours help with all rooms that a node does not measure, as in the paper.",
        "augmented": "All gains are designed together, for the noise below.",
    }[p.method]
    if p.method == "lmi" and p.own_rooms:
        observer = "Every node is detectable alone: its own gain filters the noise, and no message is needed."
    return {
        ("plant", "A"): f"""
            x: temperatures of rooms 1 to {p.rooms} in degrees Celsius, row by row of the floor plan.
            A = expm({PERIOD:g} s Ac) exactly, with Ac the negated Laplacian of the grid of rooms, weighted with
            a random rate of {WALL[0]:g} to {WALL[1]:g} 1/s for each wall.
        """,
        ("plant", "B"): f"""
            u: power of the HVAC units in kW, held over a period (exact zero-order hold of {HEAT:g} degrees per second
            and kW in the room that gives the unit its name).
        """,
        ("plant", "E"): f"w: heat into room {leaky + 1} in kW that nobody meters (people, sun), sampled like u.",
        ("observer",): observer,
        ("nodes",): f"""
            A node is told one HVAC unit. It measures the rooms of all the others, room {leaky + 1}{own}, so that every
            input which it is not told shows in its measurements (Assumption 2).
        """,
        ("run", "steps"): "long enough to forget the start from 0 degrees even without neighbours",
        ("run", "convergence"): "degrees; the sensors' noise alone leaves less than half of it",
    }
