"""Structured H2 gains for the augmented-state observer (seed 001, structure (6)).

The paper proves that gains exist and points to decentralised pole placement, which amplifies errors by 1e4 and more.
Here all nodes' gains are found together by minimising

    J = tr Cov(e) under the sensors' noise + transient * mean noise variance * sum over t of ||e-rows of Phi^t||_F^2

(columns: the initial e only) with its exact gradient. The set of stabilising gains is not convex and need not contain
the start, so Phi / gamma is stabilised first for a gamma that is large enough, and gamma is lowered step by step to the
wanted rate. There is no guarantee; several starts are tried and the best one is kept.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import observability_decomposition
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.synthesis.augmented_error import ErrorSystem, Gains, Network
from duio_mesh.synthesis.design import Progress
from duio_mesh.synthesis.lbfgs import minimise
from duio_mesh.synthesis.lyapunov import gramians

_BRAVE = 10.0  # at least this transient weight while gamma falls: noise alone may not excite an unstable mode at all
_STAGES, _PER_STAGE, _LAST = 80, 60, 500


class NothingFound(DesignError):
    """The local search found no gains; others may exist."""


def h2_gains(
    network: Network, beta: list[int], transient: float, rate: float, starts: int, seed: int, progress: Progress
) -> list[Gains]:
    """Gains of all nodes with spectral radius below ``rate`` and the least J that ``starts`` local searches found.

    ``beta`` are the augmented orders; ``transient`` >= 0 is dimensionless; the first start has K = 0, the others are
    drawn from ``seed``. Raises NothingFound when no start reaches ``rate``.
    """
    system = ErrorSystem(network, beta)
    best, value, closest = None, np.inf, np.inf
    for k in range(starts):
        progress(f"H2 design, start {k + 1} of {starts}")
        theta = _start(system, network, np.random.default_rng([seed, k]), spread=0.3 if k else 0.0)

        def say(what: str, k: int = k) -> None:
            progress(f"H2 design, start {k + 1} of {starts}: {what}")

        theta, reached = _stabilise(system, theta, rate, max(transient, _BRAVE), say)
        closest = min(closest, reached)
        if reached >= rate:
            continue
        cost = Cost(system, transient, rate, say)
        theta, J = minimise(cost, theta, _LAST, rtol=1e-9)
        if value > J:
            best, value = theta, J
    if best is None:
        raise NothingFound(
            f"gains: h2: no gains with a spectral radius below {rate:g} from {starts} starts (closest: {closest:.4g}). "
            "The search is local, so this proves nothing."
        )
    return system.gains(_unpack(system, best))


class Cost:
    """J and its gradient with respect to the free entries of Theta, for Phi / gamma instead of Phi."""

    def __init__(self, system: ErrorSystem, transient: float, gamma: float, say: Progress = lambda _: None) -> None:
        self.system, self.gamma, self._say, self._done = system, gamma, say, 0
        mean = float(np.trace(system.V)) / max(1, system.outputs)
        # without any noise the design assumes equal noise everywhere; otherwise only the covariance's shape matters
        self.V = system.V / mean if mean > 0 else np.eye(system.outputs)
        size = len(system.A0)
        self.weight = np.zeros((size, size))
        self.weight[: system.errors, : system.errors] = np.eye(system.errors)
        self.start = transient * self.weight

    def __call__(self, theta: Array) -> tuple[float, Array]:
        system, gamma = self.system, self.gamma
        self._say(f"spectral radius below {gamma:.4f}, {self._done} values of the cost")
        self._done += 1
        Theta = _unpack(system, theta)
        Phi = system.matrix(Theta)
        Gamma = system.noise_input(Phi, Theta)
        GammaV = Gamma @ self.V
        pair = gramians(Phi / gamma, GammaV @ Gamma.T + self.start, self.weight)
        if pair is None:
            return np.inf, theta
        X, Y = pair
        dGamma = 2 * Y @ GammaV
        dPhi = 2 / gamma**2 * Y @ Phi @ X - dGamma @ system.H.T
        dTheta = dPhi[system.rows] @ system.Y.T
        dTheta[:, : system.outputs] += dGamma[system.rows]
        return float(np.sum(self.weight * X)), dTheta[system.free]


def _stabilise(system: ErrorSystem, theta: Array, rate: float, transient: float, say: Progress) -> tuple[Array, float]:
    """Lower gamma from above the start's spectral radius to ``rate``; the last gains and their spectral radius."""
    radius = spectral_radius(system.matrix(_unpack(system, theta)))
    gamma = np.inf
    for _ in range(_STAGES):
        if radius < rate:
            break
        wanted = 1.02 * radius
        if wanted > 0.9995 * gamma:
            break  # stuck
        gamma = wanted
        theta, _ = minimise(Cost(system, transient, gamma, say), theta, _PER_STAGE, rtol=1e-6)
        radius = spectral_radius(system.matrix(_unpack(system, theta)))
    return theta, radius


def _unpack(system: ErrorSystem, theta: Array) -> Array:
    Theta = np.zeros(system.free.shape)
    Theta[system.free] = theta
    return Theta


def _start(system: ErrorSystem, network: Network, rng: np.random.Generator, spread: float) -> Array:
    """Mild filter gains F_i and everything else N(0, spread^2)."""
    gains = []
    Theta = spread * rng.standard_normal(system.free.shape)
    for g, sensor in zip(system.gains(Theta), network.sensors, strict=True):
        gains.append(g._replace(F=mild_filter(sensor.C, sensor.P @ network.A)))
    return system.theta(gains)[system.free]


def mild_filter(C: Array, A: Array) -> Array:
    """F (n, p) that steadies A - F C without large entries: the stationary filter for a measurement noise 100 times as
    large as the process noise, on the part of the state that C sees with a singular value of at least 1e-2.

    A node that barely sees a direction would otherwise start with gains of 100 and more, a trap for the local search.
    """
    seen = observability_decomposition(C, A, rtol=1e-2).D
    A_d, C_d = seen.T @ A @ seen, C @ seen
    if not seen.size:
        return np.zeros((len(A), len(C)))
    r = 100.0 * np.eye(len(C))
    try:
        X = linalg.solve_discrete_are(A_d.T, C_d.T, np.eye(len(A_d)), r)
    except (linalg.LinAlgError, ValueError):  # "Reordering of (A, B) failed": then the search starts without
        return np.zeros((len(A), len(C)))
    return np.asarray(seen @ A_d @ X @ C_d.T @ np.linalg.inv(C_d @ X @ C_d.T + r))
