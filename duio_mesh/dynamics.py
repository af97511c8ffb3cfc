"""The plant's recursion, its signals and its sensors: pure, shared by ``plant.py`` and ``simulation.py``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import ScenarioError
from duio_mesh.spec import PlantSpec, SensorSpec

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

SINUSOIDS = frozenset({"sine", "cosine"})
"""The kinds that a continuous plant integrates as oscillators."""


def signal(terms: Iterable[Mapping[str, Mapping[str, float]]], t: float, rng: np.random.Generator) -> float:
    """The sum of the terms at time t."""
    return sum((SIGNALS[kind](p, t, rng) for term in terms for kind, p in term.items()), 0.0)


def signals(many: Iterable[Any], t: float, rng: np.random.Generator) -> Array:
    """One value per signal, drawn in order from one stream."""
    return np.array([signal(terms, t, rng) for terms in many])


class Plant:
    """The plant and its sensors: dx/dt or x(k+1) = A x + B u + E w, measured as y_i = C_i x + F_i v_i.

    (Seed 000, (1)-(2); seed 004, (1).) ``sample`` must be called once per step, then ``advance``; noise is drawn as it
    is needed, in a fixed order. A continuous plant is propagated exactly from sample to sample, its feedback acting
    continuously; ``normal`` signals are drawn once per step and held.
    """

    def __init__(self, spec: PlantSpec) -> None:
        """Raises ScenarioError when the measurements come from outside."""
        if spec.outside:
            raise ScenarioError(["plant: external: the measurements come from outside; there is nothing to simulate"])
        self.spec = spec
        self.k = 0
        self._sensors = _Sensors(spec)
        self._motion = _Recursion(spec) if spec.time == "discrete" else _Flow(spec)
        if "value" in spec.x0:
            self.x = spec.x0["value"].copy()
        else:
            mean, std = spec.x0["mean"], spec.x0["std"]
            self.x = mean + std * _stream(spec, _STATE).standard_normal(mean.shape)
        self.u = np.zeros(spec.matrices["B"].shape[1])

    def sample(self) -> dict[int, Array]:
        """[y_i(k); u_i(k)] for every node: what the plant process sends."""
        self.u = self._motion.input(self.k, self.x)
        return self._sensors.measure(self.k, self.x, self.u)

    def advance(self) -> None:
        """From x(k) to x(k+1), under the input whose value at k ``sample`` announced."""
        self.x = self._motion.next(self.k, self.x, self.u)
        self.k += 1


def _stream(spec: PlantSpec, *purpose: int) -> np.random.Generator:
    return np.random.default_rng([spec.seed, *purpose])


class _Sensors:
    """All sensors at once: one product for all C_i x, and the noise drawn a block of steps at a time.

    The draws come in the same order as one by one: step by step, each sensor from its own stream.
    """

    BLOCK = 64  # steps

    def __init__(self, spec: PlantSpec) -> None:
        self._spec = spec
        self._C = np.vstack([s.C for s in spec.sensors])
        self._streams = [_stream(spec, _NOISE, s.id) for s in spec.sensors]
        ends = np.cumsum([s.C.shape[0] for s in spec.sensors])
        inputs = self._C.shape[0]  # u stands behind all measurements
        self._parts = {
            s.id: np.array([*range(end - s.C.shape[0], end), *(inputs + j for j in s.known)])
            for s, end in zip(spec.sensors, ends, strict=True)
        }
        self._noise = np.zeros((0, self._C.shape[0]))

    def measure(self, k: int, x: Array, u: Array) -> dict[int, Array]:
        """[y_i(k); u_i(k)] for every node; to be called for k = 0, 1, 2, ..."""
        if k % self.BLOCK == 0:
            self._noise = np.hstack(
                [self._draw(k, *pair) for pair in zip(self._spec.sensors, self._streams, strict=True)]
            )
        known = np.concatenate([self._C @ x + self._noise[k % self.BLOCK], u])
        return {i: known[part] for i, part in self._parts.items()}

    def _draw(self, k: int, sensor: SensorSpec, stream: np.random.Generator) -> Array:
        """F_i v_i of the steps k .. k + BLOCK - 1 (BLOCK, p_i)."""
        if all(len(terms) == 1 and set(terms[0]) == {"normal"} for terms in sensor.noise):
            mean, std = (np.array([terms[0]["normal"][name] for terms in sensor.noise]) for name in ("mean", "std"))
            v = mean + std * stream.standard_normal((self.BLOCK, len(sensor.noise)))
        else:
            times = [(k + ahead) * self._spec.step for ahead in range(self.BLOCK)]
            v = np.array([signals(sensor.noise, t, stream) for t in times])
        return v @ sensor.channel.T


class _Recursion:
    """x(k+1) = A x(k) + B u(k) + E w(k)."""

    def __init__(self, spec: PlantSpec) -> None:
        self._spec = spec
        self._A, self._B, self._E = (spec.matrices[name] for name in "ABE")
        self._control, self._disturbance = _stream(spec, _CONTROL), _stream(spec, _DISTURBANCE)

    def input(self, k: int, x: Array) -> Array:
        """u(k) (m,)."""
        spec = self._spec
        if spec.feedback:
            return np.asarray(spec.feedback["F"] @ (x - spec.feedback["reference"]))
        return signals(spec.control, k * spec.step, self._control)

    def next(self, k: int, x: Array, u: Array) -> Array:
        """x(k+1) (n,)."""
        w = signals(self._spec.disturbance, k * self._spec.step, self._disturbance)
        return np.asarray(self._A @ x + self._B @ u + self._E @ w)


class _Flow:
    """x(k+1) = Phi x + Psi s(k) + Gamma held(k) + switched(k), exact for dx/dt = A x + [B, E] d(t).

    ``duio_mesh.synthesis.propagation`` computes the matrices and says what they are. The oscillators s come from their
    closed form at every tick, so no rounding accumulates in them.
    """

    def __init__(self, spec: PlantSpec) -> None:
        M = spec.matrices
        self._spec = spec
        self._Phi, self._Psi, self._Gamma, self._H = M["Phi"], M["Psi"], M["Gamma"], M["H"]
        self._omega = 2 * np.pi / M["periods"]
        self._switched = dict(zip(M["switch_ticks"].astype(int).tolist(), M["switch_effects"], strict=True))
        self._held_control, self._held_disturbance = _held(spec.control), _held(spec.disturbance)
        self._control, self._disturbance = _stream(spec, _CONTROL), _stream(spec, _DISTURBANCE)
        self._held_u = -spec.feedback["F"] @ spec.feedback["reference"] if spec.feedback else np.zeros(0)

    def input(self, k: int, x: Array) -> Array:
        """u at the beginning of tick k (m,)."""
        spec = self._spec
        if spec.feedback:
            return np.asarray(spec.feedback["F"] @ (x - spec.feedback["reference"]))
        self._held_u = signals(self._held_control, k * spec.step, self._control)
        return np.asarray(self._held_u + self._H[: self._held_u.size] @ self._oscillators(k))

    def next(self, k: int, x: Array, u: Array) -> Array:
        """x at the end of tick k (n,); u itself is not needed, its parts are."""
        w = signals(self._held_disturbance, k * self._spec.step, self._disturbance)
        held = np.concatenate([self._held_u, w])
        moved: Array = self._Phi @ x + self._Psi @ self._oscillators(k) + self._Gamma @ held
        return moved + self._switched[k] if k in self._switched else moved

    def _oscillators(self, k: int) -> Array:
        phase = self._omega * (k * self._spec.step)
        return np.concatenate([np.sin(phase), np.cos(phase)])


def _held(many: Iterable[Iterable[Mapping[str, Any]]]) -> list[Any]:
    """The signals without their sinusoids: what is constant over a tick, up to switches inside it."""
    return [[term for term in terms if not SINUSOIDS & term.keys()] for terms in many]
