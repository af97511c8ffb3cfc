"""A continuous observer run on samples: exact propagation between ticks, and what sampling does to its stability.

A node has only y(k), u(k) and, from its neighbours, the difference of estimates of one common tick. Between ticks it
integrates its own linear part exactly (matrix exponential), with y and u interpolated through its own latest samples
and the coupling frozen. The error then obeys a linear recursion whose spectral radius decides whether a step is short
enough; bounds like h < 2 / (c lambda_max) are only estimates of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import SCHUR
from duio_mesh.synthesis.absence import Absence

Hold: TypeAlias = Literal["zero_order", "first_order", "quadratic"]

# rows: v(k), v(k-1), v(k-2); columns: coefficients of 1, s, s^2 with s = 0 at tick k-1 and s = 1 at tick k
_INTERPOLATION: dict[Hold, Array] = {
    "zero_order": np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 0]]),
    "first_order": np.array([[0.0, 1, 0], [1, -1, 0], [0, 0, 0]]),
    "quadratic": np.array([[0.0, 0.5, 0.5], [1, 0, -1], [0, -0.5, 0.5]]),
}


_ENOUGH = 0.95  # of the best decay rate: more coupling than that costs robustness and gains nothing
_MARGIN = 1.5  # in the step


class HoldOptions(Absence):
    """Options that every sampled continuous observer has."""

    hold: Hold = "first_order"
    """How y is interpolated between the node's own samples: error O(h), O(h^2) or O(h^3) for a smooth y."""
    input_hold: Hold | None = None
    """The same for the known inputs; default as ``hold``. ``zero_order`` is exact for inputs that are held per tick."""


class Local(NamedTuple):
    """One node between ticks: ds/dt = A s + Y y + U u + K push + bias."""

    A: Array  # (k, k)
    Y: Array  # (k, p)
    U: Array  # (k, m)
    K: Array  # (k, c)
    bias: Array  # (k,)


class Step(NamedTuple):
    """s(k) = Phi s(k-1) + Gamma history + K push(k-1) + bias, history = [y(k); u(k); y(k-1); u(k-1); ...]."""

    Phi: Array  # (k, k)
    Gamma: Array  # (k, lags (p + m))
    K: Array  # (k, c)
    bias: Array  # (k,)


def sampled(local: Local, h: float, options: HoldOptions) -> Step:
    """``local`` over one tick of h seconds, exact for inputs that follow their hold (quadratic: three lags, else two).

    The moments J_m = int_0^h exp(A (h - t)) (t/h)^m dt come from one block exponential (Van Loan).
    """
    A, Y, U, K, bias = local
    k, p = Y.shape
    inputs = np.hstack([Y, U, K, bias[:, None]])
    c = inputs.shape[1]
    chain = np.zeros((k + 3 * c, k + 3 * c))
    chain[:k, :k], chain[:k, k : k + c] = A, inputs
    chain[k : k + 2 * c, k + c :] = np.eye(2 * c) / h
    flow = linalg.expm(chain * h)[:k]
    moments = np.stack([flow[:, k : k + c], flow[:, k + c : k + 2 * c], 2 * flow[:, k + 2 * c :]])
    hold_u = options.input_hold or options.hold
    lags = 3 if "quadratic" in (options.hold, hold_u) else 2
    of_y = np.tensordot(_INTERPOLATION[options.hold], moments[:, :, :p], 1)
    of_u = np.tensordot(_INTERPOLATION[hold_u], moments[:, :, p : p + U.shape[1]], 1)
    Gamma = np.hstack([block for lag in range(lags) for block in (of_y[lag], of_u[lag])])
    return Step(flow[:, :k], Gamma, moments[0][:, p + U.shape[1] : -1], moments[0][:, -1])


class Coupled(NamedTuple):
    """What a node contributes to the error system: s' (or s+) = F s + K R d, x-hat = X s + ..., d = sum a_ij (...)."""

    F: Array  # (k, k) A or Phi
    K: Array  # (k, c)
    R: Array  # (c, n) push = R d, gain included
    X: Array  # (n, k)


def error_system(nodes: Sequence[Coupled], laplacian: Array) -> Array:
    """The stacked error matrix: blkdiag(F_i) - blkdiag(K_i R_i) (L kron I) blkdiag(X_i), in the order of ``nodes``."""
    ends = np.cumsum([len(node.F) for node in nodes])
    at = [slice(int(end) - len(node.F), int(end)) for end, node in zip(ends, nodes, strict=True)]
    Phi: Array = linalg.block_diag(*(node.F for node in nodes))
    pull = [node.K @ node.R for node in nodes]
    for i, j in zip(*np.nonzero(laplacian), strict=True):
        Phi[at[i], at[j]] -= laplacian[i, j] * pull[i] @ nodes[j].X
    return Phi


def abscissa(M: Array) -> float:
    """Largest real part of an eigenvalue; -inf for an empty matrix."""
    return float(np.linalg.eigvals(M).real.max(initial=-np.inf))


def choose_gain(
    name: str,
    wanted: float | Literal["auto"],
    abscissa_at: Callable[[float], float],
    radius_at: Callable[[float, float], float],
    h: float,
    laplacian: Array,
    cure: str = "more edges",
) -> float:
    """The coupling gain called ``name``: as wanted, or the smallest whose error decays about as fast as with any.

    ``abscissa_at(gain)`` and ``radius_at(gain, step)`` belong to the error system in continuous time and sampled.
    ``auto`` keeps a distance: its gain is stable at 1.5 times the step h too. Stable means by more than rounding:
    a radius below SCHUR, in continuous time an abscissa below log(SCHUR) / h.
    Raises DesignError with these numbers when the wanted gain, or every gain tried, is unstable; ``cure`` (words) is
    what helps where no step does.
    """
    strongest = float(np.abs(np.linalg.eigvals(laplacian)).max(initial=0.0))
    if not strongest:  # nobody listens to anybody
        return 0.0 if wanted == "auto" else wanted
    if wanted != "auto":
        growth = abscissa_at(wanted)
        if growth * h >= np.log(SCHUR):
            raise DesignError(
                f"observer.{name} = {wanted:g} is unstable at any step: the error system has an eigenvalue with real "
                f"part {growth:.4g} (must be negative, by more than rounding). Use {name}: auto, or {cure}"
            )
        rho = radius_at(wanted, h)
        if rho >= SCHUR:
            digits = 4 if rho >= 1 else 10
            raise DesignError(
                f"observer.{name} = {wanted:g} is unstable at run.step = {h:g} s: the spectral radius of the sampled "
                f"error system is {rho:.{digits}f} and must be below 1 (step x {name} x |lambda|max(L) is "
                f"{h * wanted * strongest:.3g}; above 2 no step is stable). Use {name}: auto, or another {name} or step"
            )
        return wanted
    grid = np.geomspace(1e-4, 1, 49) * 2 / (h * strongest)
    radii = np.array([max(radius_at(gain, h), 1e-300) for gain in grid])
    safe = np.array([max(rho, radius_at(gain, _MARGIN * h)) < SCHUR for gain, rho in zip(grid, radii, strict=True)])
    if not safe.any():
        _refuse_any_step(name, abscissa_at, h, strongest, cure)
        raise DesignError(
            f"no {name} between {grid[0]:.3g} and {grid[-1]:.3g} makes the sampled error system stable at run.step = "
            f"{h:g} s and at {_MARGIN} times that: its least spectral radius is {radii.min():.6f}. Use a shorter step "
            f"or {cure}"
        )
    rates = np.where(safe, -np.log(radii), -np.inf)
    return float(grid[np.argmax(rates >= _ENOUGH * rates.max())])


def _refuse_any_step(name: str, abscissa_at: Callable[[float], float], h: float, strongest: float, cure: str) -> None:
    """Raise DesignError when the error is unstable in continuous time too, with any gain that a shorter step allows."""
    grid = np.geomspace(1e-4, 1e4, 65) * 2 / (h * strongest)
    least = min(abscissa_at(gain) for gain in grid)
    if least * h >= np.log(SCHUR):
        raise DesignError(
            f"no {name} between {grid[0]:.3g} and {grid[-1]:.3g} makes the error system stable, not even in continuous "
            f"time: the least real part of its slowest eigenvalue is {least:.3g} (must be negative, by more than "
            f"rounding). A shorter step cannot help; use {cure}"
        )


def modes(values: NDArray[np.complex128]) -> list[str]:
    """Eigenvalues to be read: "-2", and "0.01 +- 7.4j" once for a conjugate pair."""
    rounded = np.round(values, 6) + 0.0
    return [f"{v.real:.4g} +- {v.imag:.4g}j" if v.imag else f"{v.real:.4g}" for v in rounded if v.imag >= 0]


def largest_step(sampled_radius: Callable[[float], float], start: float, limit: float = 10.0) -> float:
    """The step (s) at which ``sampled_radius`` first reaches 1 (SCHUR), between ``start`` and ``limit``, to 1 %.

    Returns 0 when ``start`` itself is unstable and ``limit`` when nothing up to it is.
    """
    low, high = start, start
    while sampled_radius(high) < SCHUR:
        if high >= limit:
            return limit
        low, high = high, min(1.25 * high, limit)
    if high == start:
        return 0.0
    while high > 1.01 * low:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if sampled_radius(middle) < SCHUR else (low, middle)
    return low
