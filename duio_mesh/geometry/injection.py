"""Output injections: the filter on the quotient X/W, with its free eigenvalues placed or stabilised.

``scipy.signal.place_poles`` is not used: on a pair that is not controllable it returns huge gains without a warning
(seed 003, node 1: norm 6.6e15 and wrong poles). Here only the observable part is ever touched, and what comes out is
checked.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.geometry.invariant import friend
from duio_mesh.geometry.stability import Stability
from duio_mesh.geometry.staircase import observability_decomposition
from duio_mesh.geometry.subspace import RTOL, GeometryError, as_pair, kernel, norm, quotient

MAX_GAIN = 1e6
"""Default bound on ||M||_2 relative to ||A||_2 / ||C||_2; far beyond it rounding moves the poles."""

_CURE = (
    "The outputs hardly see this part: measure it better or more directly, or choose units of states and outputs in "
    "which the matrices' entries have similar sizes"
)

_CANDIDATES = 32  # random directions tried per placement; the smallest gain wins
_COEFFICIENTS = 1e-7  # relative error of the characteristic polynomial that still counts as placed


@dataclass(frozen=True)
class ReducedObserver:
    """s+ = Abar s - P L y + P B_known u follows P x without seeing the unknown input (seed 002, (5); seed 003, (9))."""

    P: Array  # (n - w, n) canonical projection X -> X/W, orthonormal rows
    L: Array  # (n, p) friend of W
    Abar: Array  # (n - w, n - w) induced map: P (A + L C) = Abar P
    eigenvalues: NDArray[np.complex128]  # of Abar
    fixed: NDArray[np.complex128]  # those that no friend of W can move


def place(C: Array, A: Array, poles: Any, max_gain: float = MAX_GAIN) -> Array:
    """M (n, p) with eig(A + M C) = poles for an observable pair C (p, n), A (n, n).

    Solves Lambda X - X A = G C for a few fixed random G and keeps the smallest M = X^-1 G; with one output M is unique.
    ``poles``: n numbers, complex ones in conjugate pairs, repeated ones allowed.
    Raises GeometryError when the numbers do not fit, when no M reaches them (checked on the characteristic polynomial),
    or when ||M||_2 exceeds max_gain * size / ||C||_2, where size is the larger of ||A||_2 and the fastest pole.
    """
    C, A = as_pair(C, A)
    n, target = A.shape[0], np.asarray(poles, dtype=np.complex128).ravel()
    if target.size != n:
        raise GeometryError(f"{n} poles are needed for an observable part of dimension {n}, not {target.size}")
    Lambda = _real_form(target)
    if not n:
        return np.zeros((0, C.shape[0]))
    if not norm(C):
        raise GeometryError(f"no output sees the part of dimension {n} whose poles are to be placed")
    size = max(norm(A), float(np.abs(target).max()), 1e-300)
    found = [M for M in _candidates(C, A, Lambda, size) if _has_spectrum(A + M @ C, target, size)]
    best = min(found, key=norm, default=None)
    limit = max_gain * size / norm(C)
    if best is None or norm(best) > limit:
        why = "none was found at all" if best is None else f"the smallest one found has norm {norm(best):.1e}"
        raise GeometryError(
            f"no output injection of norm below {limit:.1e} places the poles {np.round(target, 6).tolist()}: {why}; "
            "the outputs hardly see this part, or the poles are too far from its own"
        )
    return best


def _candidates(C: Array, A: Array, Lambda: Array, size: float) -> Iterator[Array]:
    yield np.zeros((A.shape[0], C.shape[0]))
    rng = np.random.default_rng(0)
    for _ in range(_CANDIDATES):
        # a pole that A already has makes the Sylvester equation singular: move A's spectrum away first
        first = size / norm(C) * rng.standard_normal((A.shape[0], C.shape[0]))
        G = rng.standard_normal(first.shape)
        try:
            X = linalg.solve_sylvester(Lambda, -(A + first @ C), G @ C)
            yield first + np.linalg.solve(X, G)
        except linalg.LinAlgError:
            continue


def _real_form(poles: NDArray[np.complex128]) -> Array:
    """A real non-derogatory matrix (one Jordan chain per pole) with this spectrum."""
    upper = sorted((p for p in poles if p.imag > 0), key=lambda p: (p.real, p.imag))
    lower = sorted((p.conjugate() for p in poles if p.imag < 0), key=lambda p: (p.real, p.imag))
    if len(upper) != len(lower) or not np.allclose(upper, lower):
        raise GeometryError(f"complex poles must come in conjugate pairs: {poles.tolist()}")
    real = sorted(p.real for p in poles if not p.imag)
    blocks = [np.array([[p]]) for p in real] + [np.array([[p.real, p.imag], [-p.imag, p.real]]) for p in upper]
    Lambda: Array = linalg.block_diag(*blocks) if blocks else np.zeros((0, 0))
    starts, scale = np.cumsum([0] + [b.shape[0] for b in blocks]), max(1e-300, float(np.abs(poles).max(initial=0.0)))
    for k in range(len(blocks) - 1):
        if blocks[k].shape == blocks[k + 1].shape and np.allclose(blocks[k], blocks[k + 1]):
            i, j, d = starts[k], starts[k + 1], blocks[k].shape[0]
            Lambda[i : i + d, j : j + d] = scale * np.eye(d)
    return Lambda


def _has_spectrum(A: Array, poles: NDArray[np.complex128], size: float) -> bool:
    """Compared as characteristic polynomials, which do not care about multiplicity, in units of ``size``."""
    wanted = np.poly(poles / size)
    return bool(np.abs(np.poly(A / size) - wanted).max() <= _COEFFICIENTS * np.abs(wanted).max())


def stabilise(C: Array, A: Array, stability: Stability, max_gain: float = MAX_GAIN) -> Array:
    """M (n, p) with eig(A + M C) inside ``stability`` for an observable pair: a Kalman-type gain (Riccati equation).

    Process noise I and measurement noise ||C||^2 I for the shifted (Re) or scaled (modulus) system: with A = 0 the
    gain is already 1 / ||C||, so that ||M|| may be max_gain times max(||A||, |bound|, 1) / ||C||.
    Raises GeometryError when the Riccati equation has no solution, the result misses the region or ||M|| is too large.
    """
    C, A = as_pair(C, A)
    n = A.shape[0]
    if not n or not C.shape[0]:
        return np.zeros((n, C.shape[0]))
    Q, R = np.eye(n), max(norm(C), 1e-300) ** 2 * np.eye(C.shape[0])
    try:
        if stability.time == "discrete":
            F = A / stability.bound
            X = linalg.solve_discrete_are(F.T, C.T, Q, R)
            # outputs in very different units make this matrix ill-conditioned, not the solution; ``solve`` would warn
            M = -stability.bound * linalg.cho_solve(linalg.cho_factor(R + C @ X @ C.T), C @ X @ F.T).T
        else:
            X = linalg.solve_continuous_are((A - stability.bound * np.eye(n)).T, C.T, Q, R)
            M = -np.linalg.solve(R, C @ X).T
    except (linalg.LinAlgError, ValueError) as e:  # ValueError: "Reordering of (A, B) failed"
        raise GeometryError(
            f"no stabilising output injection can be computed for this pair and {stability} ({e}). {_CURE}"
        ) from None
    values = np.linalg.eigvals(A + M @ C)
    if not stability.stable(values):
        left = np.round(values[stability.bad(values)], 6).tolist()
        raise GeometryError(
            f"the output injection of norm {norm(M):.1e} leaves eigenvalues at {left}, outside {stability}. {_CURE}"
        )
    limit = max_gain * max(norm(A), abs(stability.bound), 1.0) / max(norm(C), 1e-300)
    if norm(M) > limit:
        raise GeometryError(
            f"the output injection that reaches {stability} has norm {norm(M):.1e}, above {limit:.1e}: rounding and "
            f"noise would be multiplied by that. {_CURE}"
        )
    return np.asarray(M)


def reduced_observer(
    C: Array,
    A: Array,
    W: Array,
    stability: Stability,
    poles: Any = None,
    L: Array | None = None,
    max_gain: float = MAX_GAIN,
    rtol: float = RTOL,
) -> ReducedObserver:
    """The filter on X/W for a (C,A)-invariant subspace W (n, w), usually W*_g.

    L is the friend to start from (default: the smallest). Only outputs that vanish on W can feed back without spoiling
    the invariance, and only the part of X/W that they observe can be moved: to the first of ``poles`` (as many as that
    part has dimensions) or, without ``poles``, into the region by ``stabilise``. Eigenvalues of the rest are ``fixed``.
    Raises GeometryError when a fixed eigenvalue is outside ``stability``, when the placement fails (``place``), or when
    the placed poles themselves are outside.
    """
    C, A = as_pair(C, A)
    L, P = friend(C, A, W, rtol) if L is None else L, quotient(W)
    lengths = np.linalg.norm(C, axis=1)
    units = np.where(lengths > 0, lengths, 1.0)
    H = kernel((C / units[:, None] @ W).T, rtol, scale=1.0).T / units  # rows: the outputs that vanish on W
    # of measurements that say the same twice, their difference vanishes everywhere: rounding, not an output
    H = H[np.linalg.norm(H @ C, axis=1) > rtol]
    Abar, Cbar = P @ (A + L @ C) @ P.T, H @ C @ P.T
    parts = observability_decomposition(Cbar, Abar, rtol)
    fixed, D = parts.eigenvalues, parts.D
    if not stability.stable(fixed):
        raise GeometryError(
            f"eigenvalues {np.round(fixed[stability.bad(fixed)], 6).tolist()} on X/W are fixed and outside {stability}"
        )
    free = Cbar @ D, D.T @ Abar @ D
    M = stabilise(*free, stability, max_gain) if poles is None else place(*free, _first(poles, D.shape[1]), max_gain)
    L = L + P.T @ D @ M @ H
    Abar = P @ (A + L @ C) @ P.T
    values = np.linalg.eigvals(Abar).astype(np.complex128)
    if not stability.stable(values):
        raise GeometryError(f"the filter on X/W has eigenvalues {np.round(values, 6).tolist()}, not all in {stability}")
    return ReducedObserver(P, L, Abar, values, fixed)


def _first(poles: Any, count: int) -> NDArray[np.complex128]:
    pool = np.asarray(poles, dtype=np.complex128).ravel()
    if pool.size < count:
        raise GeometryError(f"{count} poles can be placed on X/W but only {pool.size} are given")
    return pool[:count]
