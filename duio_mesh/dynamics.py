"""The plant's recursion, its signals and its sensors: pure, shared by ``plant.py`` and ``simulation.py``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.spec import PlantSpec

# one independent random stream per purpose and node: adding a node changes nobody else's noise
_STATE, _CONTROL, _DISTURBANCE, _NOISE = range(4)

SIGNALS: dict[str, Callable[[Mapping[str, float], float, np.random.Generator], float]] = {
    "constant": lambda p, t, rng: p["value"],
    "sine": lambda p, t, rng: p["amplitude"] * math.sin(2 * math.pi * t / p["period"] + p["phase"]),
    "cosine": lambda p, t, rng: p["amplitude"] * math.cos(2 * math.pi * t / p["period"] + p["phase"]),
    "step": lambda p, t, rng: p["after"] if t >= p["time"] else p["before"],
    "square": lambda p, t, rng: (
        p["amplitude"] if math.sin(2 * math.pi * t / p["period"] + p["phase"]) >= 0 else -p["amplitude"]
    ),
    "normal": lambda p, t, rng: p["mean"] + p["std"] * rng.standard_normal(),
}
"""Kinds of signal terms with all their parameters (the scenario fills in the defaults); t in seconds, phase in rad."""


def signal(terms: Iterable[Mapping[str, Mapping[str, float]]], t: float, rng: np.random.Generator) -> float:
    """The sum of the terms at time t."""
    return sum((SIGNALS[kind](p, t, rng) for term in terms for kind, p in term.items()), 0.0)


def signals(many: Iterable[Any], t: float, rng: np.random.Generator) -> Array:
    """One value per signal, drawn in order from one stream."""
    return np.array([signal(terms, t, rng) for terms in many])


class Plant:
    """x(k+1) = A x + B u + E w, measured as y_i = C_i x + F_i v_i (seed 000, (1)-(2)).

    ``sample`` must be called once per step, then ``advance``; noise is drawn as it is needed, in a fixed order.
    """

    def __init__(self, spec: PlantSpec) -> None:
        def stream(*purpose: int) -> np.random.Generator:
            return np.random.default_rng([spec.seed, *purpose])

        self.spec = spec
        self.k = 0
        self._A, self._B, self._E = (spec.matrices[name] for name in "ABE")
        self._control, self._disturbance = stream(_CONTROL), stream(_DISTURBANCE)
        self._noise = {s.id: stream(_NOISE, s.id) for s in spec.sensors}
        if "value" in spec.x0:
            self.x = spec.x0["value"].copy()
        else:
            mean, std = spec.x0["mean"], spec.x0["std"]
            self.x = mean + std * stream(_STATE).standard_normal(mean.shape)
        self.u = np.zeros(self._B.shape[1])

    def sample(self) -> dict[int, Array]:
        """[y_i(k); u_i(k)] for every node: what the plant process sends."""
        t, spec = self.k * self.spec.step, self.spec
        if spec.feedback:
            self.u = spec.feedback["F"] @ (self.x - spec.feedback["reference"])
        else:
            self.u = signals(spec.control, t, self._control)
        data = {}
        for s in spec.sensors:
            y = s.C @ self.x + s.channel @ signals(s.noise, t, self._noise[s.id])
            data[s.id] = np.concatenate([y, self.u[list(s.known)]])
        return data

    def advance(self) -> None:
        """From x(k) to x(k+1) under the u(k) that ``sample`` announced."""
        w = signals(self.spec.disturbance, self.k * self.spec.step, self._disturbance)
        self.x = self._A @ self.x + self._B @ self.u + self._E @ w
        self.k += 1
