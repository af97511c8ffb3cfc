"""Output-injection gains of one node's detectable part (seed 000, section 5.2).

    e(k+1) = (A - K C) e(k) + K v(k) - F v(k+1)                                                          (26)

A is A_id (d, d), C is C_id (p, d), F is D_i' E_i (d, p). Everything here makes A - K C Schur or raises DesignError
with ``node`` as the first word of its text.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import observability_decomposition
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.geometry.subspace import norm

TOLERANCE = 1e-6
"""Relative accuracy of the H-infinity bound."""


NEARLY = 1e-6
"""An own spectral radius this close to 1 is not taken as stable without a gain: its error would never vanish."""


class Subsystem(NamedTuple):
    """The detectable part of one node."""

    A: Array  # (d, d)
    C: Array  # (p, d)
    F: Array  # (d, p)

    @property
    def stir(self) -> float:
        """Standard deviation of a small fictitious process noise, per unit of measurement noise.

        Modes that no noise reaches have no best gain (it would tend to a gain that does not stabilise); this gives
        them one and changes the others by a relative 1e-5.
        """
        size = norm(self.C)
        return 1e-4 * max(norm(self.F), 1 / size if size else 1.0)


def worst_gain(system: Subsystem, K: Array) -> float:
    """J_i of (33): the largest singular value of [v(k); v(k+1)] -> e on a grid of frequencies and at all resonances."""
    A, C, F = system
    if not A.size:
        return 0.0
    closed = A - K @ C
    resonances = np.abs(np.angle(np.linalg.eigvals(closed)))
    angles = np.concatenate([np.linspace(0, np.pi, 65), np.unique(resonances.round(14))])  # a conjugate pair has one
    resolvents = np.exp(1j * angles)[:, None, None] * np.eye(len(A)) - closed
    inputs = np.hstack([K, -F])
    responses = np.linalg.solve(resolvents, np.broadcast_to(inputs, (len(angles), *inputs.shape)))
    squares = np.linalg.eigvalsh(responses.conj().transpose(0, 2, 1) @ responses)  # (2p, 2p), far smaller than d
    return float(np.sqrt(squares.max(initial=0.0)))


def hinf_gain(system: Subsystem, node: str) -> tuple[Array, float]:
    """K (d, p) with the least beta of (34), and that beta.

    (34) is feasible for beta exactly when the game Riccati equation

        X = F F' + A (X^-1 - I / beta^2 + C'C)^-1 A'

    has a stabilising solution 0 <= X < beta^2 I; then K = A Y C' (I + C Y C')^-1 with Y = (X^-1 - I / beta^2)^-1.
    Bisection on beta with this test gives the optimum of the semidefinite program (34) itself (the tests compare them),
    in milliseconds and without the ill-conditioned P of (34). The accepted beta is confirmed by a frequency sweep; when
    it is not, rounding has misled the bisection, and every step of a second one is confirmed.
    """
    if not system.F.any() and spectral_radius(system.A) < 1 - NEARLY:  # rounding prints an eigenvalue 1 as 1 - 1e-16
        return np.zeros((len(system.A), len(system.C))), 0.0  # nothing to decouple, nothing to stabilise
    for confirmed in (False, True):
        K, beta = _bisection(system, node, confirmed)
        if worst_gain(system, K) <= beta * (1 + TOLERANCE):
            return K, beta
    raise DesignError(f"{node}: the H-infinity gain cannot be computed reliably; use local_gain: h2")


def _bisection(system: Subsystem, node: str, confirmed: bool) -> tuple[Array, float]:
    low = float(np.hypot(norm(system.F), system.stir))  # the answer to an impulse begins with -F, whatever K is
    central = _central_gain(system, np.inf, confirmed)
    if central is None:
        raise DesignError(
            f"{node}: no stabilising gain was found for its detectable part (eigenvalues of A_id: "
            f"{_numbers(np.linalg.eigvals(system.A))}). A mode is too close to being undetectable; measure it better."
        )
    beta = max(1.01 * worst_gain(system, central.K), low)
    for _ in range(100):
        better = _central_gain(system, beta, confirmed)
        if better is not None:
            break
        beta *= 1.5
    else:
        raise DesignError(f"{node}: the H-infinity gain cannot be computed reliably; use local_gain: h2")
    feasible = [(beta, better)]
    while feasible[-1][0] > low * (1 + TOLERANCE):
        beta = _next(feasible, low)
        better = _central_gain(system, beta, confirmed)
        if better is None:
            low = beta
        else:
            feasible.append((beta, better))
    return feasible[-1][1].K, feasible[-1][0]


def _next(feasible: list[tuple[float, _Central]], low: float) -> float:
    """Where the bisection looks next: where the room to X < beta^2 I is expected to end, else in the middle.

    The largest beta^2 / |X| falls to 1 nearly linearly and from above a secant, so secants stay on the feasible side
    and close in fast. Where something else ends the feasible interval, they leave it, and the middle is taken.
    """
    high, last = feasible[-1]
    if len(feasible) > 1:
        before, first = feasible[-2]
        slope = (first.room - last.room) / (before - high)
        end = high - (last.room - 1) / slope if slope > 0 else 0.0
        if low < end * (1 - TOLERANCE / 2):
            return end * (1 + TOLERANCE / 4) if high > end * (1 + TOLERANCE / 2) else end * (1 - TOLERANCE / 2)
    return max(float(np.sqrt(low * high)), 0.1 * high)


class _Central(NamedTuple):
    K: Array
    room: float  # beta^2 / |X|


def _central_gain(system: Subsystem, beta: float, confirmed: bool) -> _Central | None:
    """The K of the Riccati equation for this beta, or None: no stabilising solution, or (``confirmed``) K misses beta.

    Solved by structured doubling: step k holds the equation's value after 2^k steps of the finite-horizon game.
    """
    A, C, F = system
    I = np.eye(len(A))
    a, G, X = A.T, C.T @ C - I / beta**2, F @ F.T + system.stir**2 * I
    try:
        with np.errstate(all="ignore"):
            for _ in range(60):
                W = np.linalg.solve(I + G @ X, np.hstack([a, G]))
                step = a.T @ X @ W[:, : len(A)]
                G = _symmetric(G + a @ W[:, len(A) :] @ a.T)
                a, X = a @ W[:, : len(A)], _symmetric(X + step)
                if np.isfinite(beta):
                    np.linalg.cholesky(I - X / beta**2)  # X < beta^2 I
                if np.linalg.norm(step) <= 1e-14 * np.linalg.norm(X):
                    break
            Y = _symmetric(np.linalg.solve(I - X / beta**2, X))
            K = np.linalg.solve(np.eye(len(C)) + C @ Y @ C.T, C @ Y @ A.T).T
            closed = A - K @ C
            balance = F @ F.T + system.stir**2 * I + K @ K.T + closed @ Y @ closed.T
            if not (np.linalg.norm(balance - X) <= 1e-5 * np.linalg.norm(X) and spectral_radius(closed) < 1):
                return None
    except (np.linalg.LinAlgError, ValueError):  # singular, X >= beta^2 I somewhere, or no longer finite
        return None
    missed = confirmed and worst_gain(system, _array(K)) > beta * (1 + TOLERANCE)
    return None if missed else _Central(_array(K), beta**2 / norm(X))


def h2_gain(system: Subsystem, seen: Array, noise: Array, node: str) -> Array:
    """K (d, p) with the least stationary trace of cov e under white v(k) with covariance ``noise`` (p, p).

    e = s - F v with s(k+1) = A s - K (C s - (I + C F) v) - A F v, so v(k) enters once: state noise -A F v and
    measurement noise -(I + C F) v, correlated. s(k) does not depend on v(k), so cov e = cov s + F noise F' and K is the
    gain of the Kalman predictor for s. I + C F = I + C_i E_i projects onto the measurements that the unknown inputs do
    not reach directly; the others carry no innovation (C_i xi_i = 0 there), so the filter runs on ``seen``' y, where
    ``seen`` (p, p - r) is an orthonormal basis of that image. Only the shape of ``noise`` matters; zero counts as I.
    """
    A, C, F = system
    V = noise if noise.any() else np.eye(len(C))
    V = V + 1e-6 * norm(V) * np.eye(len(C))  # a channel without noise would ask for an infinite gain
    Cs, AF = seen.T @ C, A @ F
    Q = _symmetric(AF @ V @ AF.T) + system.stir**2 * norm(V) * np.eye(len(A))
    S, R = AF @ V @ seen, _symmetric(seen.T @ V @ seen)
    try:
        X = linalg.solve_discrete_are(A.T, Cs.T, Q, R, s=S)
    except (linalg.LinAlgError, ValueError) as e:
        raise DesignError(f"{node}: the Riccati equation of the H2 gain has no stabilising solution ({e})") from None
    K: Array = np.linalg.solve(R + Cs @ X @ Cs.T, (A @ X @ Cs.T + S).T).T @ seen.T
    if not spectral_radius(A - K @ C) < 1:
        raise DesignError(f"{node}: the H2 gain does not stabilise its detectable part numerically")
    return K


def placed_gain(system: Subsystem, low: float, high: float, node: str) -> Array:
    """K (d, p) that puts the eigenvalues of the observable part of A - K C evenly on [low, high].

    Unobservable modes of the detectable part are stable and stay where they are. The achieved eigenvalues are checked.
    """
    from scipy import signal  # 0.6 s, and only this option needs it

    A, C, _ = system
    D = observability_decomposition(C, A).D
    wanted = np.linspace(low, high, D.shape[1])
    if not wanted.size:
        return np.zeros((len(A), len(C)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the robustness iteration; the spectrum itself is checked below
            K = D @ signal.place_poles((D.T @ A @ D).T, (C @ D).T, wanted).gain_matrix.T
    except ValueError as e:
        raise DesignError(f"{node}: poles {low:g} to {high:g} cannot be placed: {e}") from None
    achieved = np.linalg.eigvals(D.T @ (A - K @ C) @ D)
    error = float(np.abs(np.sort_complex(achieved) - wanted).max())
    if error > 1e-3:
        raise DesignError(
            f"{node}: poles {low:g} to {high:g} are too hard to place: asked for {_numbers(wanted)}, got "
            f"{_numbers(np.sort_complex(achieved))}. Ask for slower poles, or use local_gain: hinf or h2."
        )
    return _array(K)


def _symmetric(M: Any) -> Array:
    return _array((M + M.T) / 2)


def _array(M: Any) -> Array:
    return np.asarray(M, dtype=np.float64)


def _numbers(values: Any) -> str:
    return ", ".join(f"{v:.4g}" for v in values)
