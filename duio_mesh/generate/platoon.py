"""Vehicles in a row, each of which knows its own acceleration only (a plant for seed 002's observer)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import ScenarioError
from duio_mesh.generate.document import Document, rows
from duio_mesh.generate.graphs import edges
from duio_mesh.generate.sampling import zero_order_hold
from duio_mesh.synthesis.admm_rates import spectrum

PERIOD = 0.1  # s
DRAG = (0.02, 0.06)  # 1/s: air and rolling resistance linearised at 90 km/h, from laden to empty
NOISE = 0.05  # m and m/s, standard deviation
LOST = 1e-7  # what the exact fusion may lose to rounding; the design refuses 1e-6
METHODS = ("admm",)


@dataclass(frozen=True)
class Platoon:
    """The parameters; ``document`` raises ScenarioError when they make no sense."""

    vehicles: int
    graph: str = "path"
    method: str = "admm"
    seed: int = 0


def document(p: Platoon) -> Document:
    """The topology of p.vehicles vehicles, a node in each."""
    if not 2 <= p.vehicles <= 500:
        raise ScenarioError([f"--vehicles: should be between 2 and 500, not {p.vehicles}"])
    n, rng = 2 * p.vehicles, np.random.default_rng(p.seed)
    parts = [zero_order_hold(*_vehicle(drag), PERIOD) for drag in rng.uniform(*DRAG, p.vehicles)]
    A, B = linalg.block_diag(*(A for A, _ in parts)), linalg.block_diag(*(B for _, B in parts))
    names = [f"a{i}" for i in range(1, p.vehicles + 1)]
    links = edges(p.graph, p.vehicles, rng)
    fusion = _fusion(p.vehicles, links)
    content = {
        "name": f"platoon-{p.vehicles}-{p.graph}",
        "description": f"Platoon of {p.vehicles} vehicles with an observer in each on a {p.graph} graph",
        "plant": {
            "time": "discrete",
            "period": PERIOD,
            "A": A,
            "B": B,
            "inputs": names,
            "E": B[:, :1],
            "x0": {"normal": {"mean": 0, "std": 1}},
            "control": {"lqr": {"Q": 1, "R": 10}},
            "disturbance": [[{"sine": {"amplitude": 0.5, "period": 20}}, {"square": {"amplitude": 0.3, "period": 33}}]],
            "noise": {"std": NOISE},
        },
        "observer": {"method": "admm", **fusion},
        "nodes": {i: {"C": _sensors(n, i), "knows": [names[i - 1]]} for i in range(1, p.vehicles + 1)},
        "graph": {"edges": links},
        "run": {"steps": 600, "seed": 0, "convergence": {"rms_below": 0.15, "over_last": 0.5}},
    }
    return Document(content, _heading(p), _comments(p, str(fusion["fusion"])))


def _vehicle(drag: float) -> tuple[Array, Array]:
    """d(position, speed)/dt with the acceleration that the engine asks for."""
    return np.array([[0, 1], [0, -drag]]), np.array([[0.0], [1.0]])


def _sensors(n: int, i: int) -> Array:
    """Position and speed of vehicle i, and how much closer the one in front is than it should be."""
    own = 2 * (i - 1)
    C = rows(n, own, own + 1)
    if i == 1:
        return C
    gap = np.zeros((1, n))
    gap[0, own - 2], gap[0, own] = 1, -1
    return np.vstack([C, gap])


def _fusion(N: int, links: list[tuple[int, int]]) -> dict[str, str | int]:
    """The exact fusion where the graph's spectrum lets it keep its digits, else ADMM with many iterations."""
    L = np.zeros((N, N))
    for i, j in links:
        L[i - 1, j - 1] = L[j - 1, i - 1] = -1
    L -= np.diag(L.sum(axis=1))
    mean = np.eye(N)
    for value in spectrum(L):
        mean = mean - L @ mean / value
    if N * np.linalg.norm(mean - 1 / N, 2) < LOST:
        return {"fusion": "finite_time"}
    return {"fusion": "admm", "nu": max(300, 20 * N)}


def _heading(p: Platoon) -> str:
    return f"""
        {p.vehicles} vehicles in a row, an observer in each. A vehicle knows the acceleration that its own engine and
        brakes give it, nobody else's, and nobody is told the wind and the hills that the first one meets. So no vehicle
        can follow more than itself, and together they know everything (seed 002; no rank condition is asked of a node).
    """


def _comments(p: Platoon, fusion: str) -> dict[tuple[str | int, ...], str]:
    fused = {
        "finite_time": "Exact fusion of what all vehicles know, in one round per different eigenvalue of the graph.",
        "admm": "This graph's eigenvalues lie too close for fusion: finite_time; ADMM comes close in nu iterations.",
    }[fusion]
    return {
        ("plant", "A"): f"""
            x: position (m) and speed (m/s) of vehicles 1 (in front) to {p.vehicles}, each against its own place in a
            platoon at constant speed. Every vehicle is dv/dt = -drag v + a with a random drag of
            {DRAG[0]:g} to {DRAG[1]:g} 1/s (air and rolling resistance, linearised), sampled exactly.
        """,
        ("plant", "B"): "u: acceleration by engine and brakes of each vehicle in m/s^2, held over a period.",
        ("plant", "E"): "w: acceleration of vehicle 1 by wind and slope, m/s^2.",
        ("plant", "control"): "keeps the vehicles in their places",
        ("observer",): fused,
        ("nodes",): """
            Each vehicle measures its own position and speed and, by radar, how much closer than wanted the vehicle
            in front is.
        """,
        ("run", "convergence"): "m and m/s; the sensors' noise alone leaves less than a third of it",
    }
