"""Gains through one channel per component: the classical decentralised designs (seed 001, section IV).

All nodes but one, the channel c, get fixed F_i and K_i. Generic ones make the stacked error controllable and
observable from node c alone, which sees s_c and acts on e_c; a dynamic compensator there (K_c, Q_c, R_c, S_c) does the
rest. Phi is block triangular over the strongly connected components, so each component gets its own channel.

Everything goes through n inputs of one node and its few neighbours, so the gains are large and the transient is larger:
Brasch-Pearson pole placement is practical up to a stacked order of about 10, the full-order LQG compensator always
works but with peaks of 1e3 and more. The structured H2 design needs neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.augmented_error import Gains, Network, static_gains
from duio_mesh.synthesis.augmented_existence import Component
from duio_mesh.synthesis.augmented_h2 import mild_filter
from duio_mesh.synthesis.design import Progress
from duio_mesh.synthesis.lyapunov import gramians

Compensator = Callable[[Array, Array, Array], tuple[Array, Array, Array, Array]]
"""(A, B, C) of one component seen from its channel -> (K, Q, R, S): u = K y + Q xi, xi+ = S xi + R y."""


class Fixed(NamedTuple):
    """How the gains that the compensator does not choose are made."""

    ids: tuple[int, ...]  # all nodes, ascending
    channel: int | None  # this node, or the best one of its component
    F: Mapping[int, Array]  # given ones, by node id
    K: Mapping[int, Array]
    spreads: tuple[float, ...]  # standard deviations of the random K_i, used in turn
    tries: int  # draws per channel
    seed: int


class NoCompensator(DesignError):
    """No draw makes the errors of a component stable."""


def channel_gains(
    network: Network, parts: Sequence[Component], fixed: Fixed, compensator: Compensator, progress: Progress
) -> list[Gains]:
    """Gains of all nodes, ascending: per component those of all draws and channels with the least sum of ||Phi^t||_F^2.

    Raises NoCompensator when no draw makes a component's error stable.
    """
    gains: dict[int, Gains] = {}
    for part in parts:
        at = [fixed.ids.index(i) for i in part.ids]
        if part.source and len(at) == 1:  # hears nobody: its own filter must do
            sensor, i = network.sensors[at[0]], part.ids[0]
            F = fixed.F.get(i, mild_filter(sensor.C, sensor.P @ network.A))
            gains[i] = static_gains(F, np.zeros((network.n, network.n)))
            continue
        channels = [part.ids.index(fixed.channel)] if fixed.channel in part.ids else range(len(at))
        attempts = [(c, k) for c in channels for k in range(fixed.tries)]
        best: tuple[float, list[Gains]] = np.inf, []
        for done, (c, k) in enumerate(attempts, 1):
            progress(f"compensator for nodes {', '.join(map(str, part.ids))}: draw {done} of {len(attempts)}")
            found = _attempt(network, at, c, k, fixed, compensator)
            best = found if found[0] < best[0] else best
        if not np.isfinite(best[0]):
            raise NoCompensator(
                f"no compensator at one of the nodes {', '.join(map(str, part.ids))} makes their errors stable "
                f"(stacked order {network.n * len(at)}, {fixed.tries} draws). Use gains: h2."
            )
        gains.update(zip(part.ids, best[1], strict=True))
    return [gains[i] for i in fixed.ids]


def _attempt(
    network: Network, at: Sequence[int], c: int, draw: int, fixed: Fixed, compensator: Compensator
) -> tuple[float, list[Gains]]:
    """Cost (inf when it is not stable) and gains of the component with the nodes ``at`` through its c-th node."""
    n, N = network.n, len(at)
    rng = np.random.default_rng([fixed.seed, at[c], draw])
    gains = []
    for i in at:
        sensor, node = network.sensors[i], fixed.ids[i]
        random_K: Array = fixed.spreads[draw % len(fixed.spreads)] * rng.standard_normal((n, n))
        # F must be generic even where it can move no eigenvalue: F = 0 may leave all N_i one eigenvector in common
        F = mild_filter(sensor.C, sensor.P @ network.A) + 0.3 * rng.standard_normal(sensor.H.shape)
        gains.append(static_gains(fixed.F.get(node, F), fixed.K.get(node, random_K)))
    heard = np.kron(network.laplacian[np.ix_(at, at)], np.eye(n)).astype(np.float64)
    own = slice(c * n, (c + 1) * n)
    K = linalg.block_diag(*[g.K if k != c else np.zeros((n, n)) for k, g in enumerate(gains)])
    sensors = [network.sensors[i] for i in at]
    N_S = linalg.block_diag(*[s.P @ network.A - g.F @ s.C for s, g in zip(sensors, gains, strict=True)])
    A, B, C = N_S + K @ heard, np.eye(n * N)[:, own], heard[own]
    try:
        K_c, Q, R, S = compensator(A, B, C)
    except (linalg.LinAlgError, ValueError):  # this draw is not controllable and observable from c, or hardly
        return np.inf, gains
    gains[c] = Gains(gains[c].F, K_c, Q, R, S)
    Phi = np.block([[A + B @ K_c @ C, B @ Q], [R @ C, S]])
    both = gramians(Phi, np.eye(len(Phi)), np.eye(len(Phi))) if np.isfinite(Phi).all() else None
    return (np.inf if both is None else float(np.trace(both[0]))), gains


def lqg(rate: float) -> Compensator:
    """The full-order compensator: optimal state feedback on the stationary filter's estimate (beta = order of A).

    Weights and covariances are identities; eigenvalues of the two parts have moduli below ``rate``.
    """

    def design(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array, Array]:
        A_r, B_r, C_r = A / rate, B / rate, C / rate
        state, inputs, outputs = np.eye(len(A)), np.eye(B.shape[1]), np.eye(len(C))
        X = linalg.solve_discrete_are(A_r, B_r, state, inputs)
        feedback = linalg.solve(inputs + B_r.T @ X @ B_r, B_r.T @ X @ A_r, assume_a="pos")
        Z = linalg.solve_discrete_are(A_r.T, C_r.T, state, outputs)
        filter_gain = linalg.solve(outputs + C_r @ Z @ C_r.T, C_r @ Z @ A_r.T, assume_a="pos").T
        return np.zeros((B.shape[1], len(C))), -feedback, filter_gain, A - B @ feedback - filter_gain @ C

    return design


def brasch_pearson(radius: float) -> Compensator:
    """Poles evenly on the circle |z| = radius (0: all in zero, deadbeat), seed 001's [1], in the form of Example 9.

    K = I + k 1', R = [1'; 0], S a companion matrix with first row s: the sum w = 1'y of the outputs feeds a chain of
    beta = N - 1 delays, N the number of nodes, and the compensator from w to u has the transfer function n(z) / d(z).
    With w = b(z)/a(z) u in the plant A + B C, d a - n b = z^M - radius^M is linear in the M = order + beta unknown
    coefficients; it is solved at M points of the unit circle, which loses fewer digits than comparing coefficients.
    """

    def design(A: Array, B: Array, C: Array) -> tuple[Array, Array, Array, Array]:
        m = B.shape[1]
        beta = len(A) // m - 1
        M = len(A) + beta
        A, c = A + B @ C, C.sum(axis=0)
        poles = np.linalg.eigvals(A)
        rows, right = [], []
        for z in np.exp(2j * np.pi * (np.arange(M) + 0.5) / M):
            a = np.prod(z - poles)
            b = a * (c @ np.linalg.solve(z * np.eye(len(A)) - A, B))
            chain = z ** np.arange(beta, -1, -1)
            rows.append(np.concatenate([-a * chain[1:], -np.kron(chain, b)]))
            right.append(z**M - radius**M - a * chain[0])
        left, known = np.array(rows), np.array(right)
        x, _, rank, _ = np.linalg.lstsq(np.vstack([left.real, left.imag]), np.r_[known.real, known.imag], rcond=1e-15)
        if rank < M:
            raise np.linalg.LinAlgError("not controllable and observable from this channel")
        s, n = x[:beta], x[beta:].reshape(beta + 1, m).T
        k, S, R = n[:, 0], np.eye(beta, k=-1), np.zeros((beta, len(C)))
        S[:1], R[:1] = s, 1.0
        return np.eye(m) + np.outer(k, np.ones(len(C))), n[:, 1:] + np.outer(k, s), R, S

    return design
