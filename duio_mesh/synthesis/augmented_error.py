"""The stacked error recursion of the augmented-state observer (seed 001, (11)-(12)) as a function of its gains.

With e_i = x - x-hat_i and s_i = sum_j a_ij (x-hat_j - x-hat_i) = [(Lap x I) e]_i structure (6) gives, once N, M, L
and H satisfy (9),

    e_i+  = (P_i A - F_i C_i) e_i + K_i s_i + Q_i xi_i      P_i = I - H_i C_i, (14)
    xi_i+ = S_i xi_i + R_i s_i.

So the whole design is one static, block diagonal output feedback: node i sees its innovation C_i e_i, its disagreement
s_i and its own xi_i, and acts on e_i and xi_i. ``ErrorSystem`` is that view: ``matrix`` = A0 + (rows) Theta Y.
With delay 1 every message is one step old and s_i is formed from e(t-1) of both sides; the state is then
[e(t); e(t-1); xi(t)].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.synthesis.sampled import Coupled


class Sensor(NamedTuple):
    """What the design needs of one node."""

    C: Array  # (p, n)
    P: Array  # (n, n), I - H C, with P D = 0
    H: Array  # (n, p)
    V: Array  # (p, p) covariance of the measurement noise


class Network(NamedTuple):
    """Plant, sensors in ascending order of their ids, and who hears whom."""

    A: Array  # (n, n)
    sensors: tuple[Sensor, ...]
    laplacian: Array  # (N, N), row i: diag(sum of a_ij) - a_ij
    delay: int  # steps by which every message is late: 0 or 1

    @property
    def n(self) -> int:
        """States of the plant."""
        return int(self.A.shape[0])


class Gains(NamedTuple):
    """The free gains of one node in (6); beta = rows of S."""

    F: Array  # (n, p), L = F + N H
    K: Array  # (n, n)
    Q: Array  # (n, beta)
    R: Array  # (beta, n)
    S: Array  # (beta, beta)

    @property
    def theta(self) -> Array:
        """[e+; xi+] as a gain (n + beta, p + n + beta) on [C e; s; xi]."""
        return np.block([[-self.F, self.K, self.Q], [np.zeros((len(self.S), self.F.shape[1])), self.R, self.S]])


def static_gains(F: Array, K: Array) -> Gains:
    """Gains without an augmented state (beta = 0)."""
    n = F.shape[0]
    return Gains(F, K, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, 0)))


class ErrorSystem:
    """e(t), [e(t-1)], xi(t) of all nodes for any gains of the given augmented orders ``beta``."""

    def __init__(self, network: Network, beta: Sequence[int]) -> None:
        sensors, n, N = network.sensors, network.n, len(network.sensors)
        p, b = sum(len(s.C) for s in sensors), sum(beta)
        delayed = n * N if network.delay else 0
        size = n * N + delayed + b
        e, old, xi = slice(0, n * N), slice(delayed, n * N + delayed), slice(size - b, size)
        self.errors = n * N
        self.outputs = p
        self.A0 = np.zeros((size, size))
        self.A0[e, e] = linalg.block_diag(*[s.P @ network.A for s in sensors])
        if delayed:
            self.A0[old, e] = np.eye(n * N)
        self.Y = np.zeros((p + n * N + b, size))
        self.Y[:p, e] = linalg.block_diag(*[s.C for s in sensors])
        self.Y[p : p + n * N, old] = np.kron(network.laplacian, np.eye(n))
        self.Y[p + n * N :, xi] = np.eye(b)
        self.H = np.zeros((size, p))
        self.H[e] = linalg.block_diag(*[s.H for s in sensors])
        self.V = linalg.block_diag(*[s.V for s in sensors])
        self.rows = np.r_[e, xi]
        self._blocks = [_block(i, n, [len(s.C) for s in sensors], beta) for i in range(N)]
        self.free = np.zeros((n * N + b, p + n * N + b), dtype=bool)
        for (at, seen), sensor in zip(self._blocks, sensors, strict=True):
            self.free[np.ix_(at, seen)] = True
            self.free[np.ix_(at[n:], seen[: len(sensor.C)])] = False  # xi is not driven by the innovation in (6)

    def theta(self, gains: Sequence[Gains]) -> Array:
        """All nodes' gains in one matrix, zero outside the blocks."""
        Theta = np.zeros(self.free.shape)
        for (at, seen), g in zip(self._blocks, gains, strict=True):
            Theta[np.ix_(at, seen)] = g.theta
        return Theta

    def gains(self, Theta: Array) -> list[Gains]:
        """The inverse of ``theta``."""
        n = self.errors // len(self._blocks)
        found = []
        for at, seen in self._blocks:
            G = Theta[np.ix_(at, seen)]
            p = len(seen) - len(at)
            found.append(Gains(-G[:n, :p], G[:n, p : p + n], G[:n, p + n :], G[n:, p : p + n], G[n:, p + n :]))
        return found

    def matrix(self, Theta: Array) -> Array:
        """Phi of (12)."""
        Phi = self.A0.copy()
        Phi[self.rows] += Theta @ self.Y
        return Phi

    def noise_input(self, Phi: Array, Theta: Array) -> Array:
        """Gamma (size, p) of [e + H v; ...]+ = Phi [e + H v; ...] + Gamma v, for y_i = C_i x + v_i.

        e itself is driven by v(t) and v(t+1); e(t) + H v(t) depends on v(0) ... v(t-1) only.
        """
        Gamma = -Phi @ self.H
        Gamma[self.rows] += Theta[:, : self.outputs]
        return Gamma

    def predicted_rms(self, Theta: Array, units: Array | float = 1.0) -> Array:
        """(N,) stationary RMS error per state of each node under the noise V; infinite unless Phi is Schur.

        ``units`` (n,): of the states.
        """
        Phi = self.matrix(Theta)
        N = len(self._blocks)
        if spectral_radius(Phi) >= 1:
            return np.full(N, np.inf)
        Gamma = self.noise_input(Phi, Theta)
        X = linalg.solve_discrete_lyapunov(Phi, Gamma @ self.V @ Gamma.T) + self.H @ self.V @ self.H.T
        return np.asarray(np.sqrt((units**2 * np.diag(X)[: self.errors].reshape(N, -1)).mean(axis=1)))


def _block(i: int, n: int, p: Sequence[int], beta: Sequence[int]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows [e_i; xi_i] and columns [C_i e_i; s_i; xi_i] of node i in the stacked gain."""
    N, all_p = len(p), sum(p)
    e, xi = np.arange(i * n, (i + 1) * n), np.arange(sum(beta[:i]), sum(beta[: i + 1]))
    innovation = np.arange(sum(p[:i]), sum(p[: i + 1]))
    return np.r_[e, n * N + xi], np.r_[innovation, all_p + e, all_p + n * N + xi]


class Transient(NamedTuple):
    """How the powers of Phi behave: ||Phi^t||_2."""

    peak: float  # the largest; the factor by which an initial error may grow
    steps: int | None  # the first t with ||Phi^t|| < 1e-3; None when it takes more than ``_LONGEST``


_LONGEST = 3000


def transient(Phi: Array) -> Transient:
    """Peak of the powers (of the first 3000 at most) and the steps to 1e-3; (inf, None) unless Phi is Schur."""
    if spectral_radius(Phi) >= 1:
        return Transient(np.inf, None)
    power, peak = np.eye(len(Phi)), 0.0
    for t in range(_LONGEST):
        size = float(np.linalg.norm(power, 2))
        peak = max(peak, size)
        if size < 1e-3:
            return Transient(peak, t)
        power = Phi @ power
    return Transient(peak, None)


def distance_to_instability(Phi: Array) -> float:
    """The 2-norm of the smallest complex perturbation that makes Phi lose Schur stability; 0 when it has none.

    min over the unit circle of the least singular value of z I - Phi: at 91 angles and at those of the eigenvalues
    (where the dips are), then refined around the three lowest. From above: a dip between all of them would be missed.
    """
    from scipy.optimize import minimize_scalar

    values = np.linalg.eigvals(Phi)
    if np.abs(values).max(initial=0.0) >= 1:
        return 0.0
    identity = np.eye(len(Phi))

    def least(angle: float) -> float:
        return float(np.linalg.svd(np.exp(1j * angle) * identity - Phi, compute_uv=False)[-1])

    angles = np.unique(np.r_[np.linspace(0, np.pi, 91), np.abs(np.angle(values))])
    found = np.array([least(a) for a in angles])
    outer = np.r_[-angles[1], angles, 2 * np.pi - angles[-2]]  # the function is even around 0 and pi
    refined = [
        minimize_scalar(least, bounds=(outer[k], outer[k + 2]), method="bounded").fun for k in np.argsort(found)[:3]
    ]
    return float(min(found.min(), *refined))


def error_blocks(matrices: Mapping[str, Array], delay: int) -> Coupled:
    """One node's part of Phi (12) from what the node is given: N, K, Q, R, S of (6).

    State [e; xi], with delay 1 [e(t); e(t-1); xi], and s_i formed from the older error.
    """
    N, K, Q, R, S = (matrices[name] for name in "NKQRS")
    n, beta = Q.shape
    old = n if delay else 0
    F = linalg.block_diag(N, np.zeros((old, old)), S)
    F[:n, n + old :] = Q
    F[n : n + old, :n] = np.eye(old, n)
    pull = np.vstack([-K, np.zeros((old, n)), -R])  # Coupled subtracts
    X = np.zeros((n, n + old + beta))
    X[:, old : old + n] = np.eye(n)
    return Coupled(F, np.eye(len(F)), pull, X)
