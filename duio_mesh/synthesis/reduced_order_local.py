"""One node of seed 004: measurement noise and unknown input out, undetectable part split off, local gains.

The seed's formulas (1)-(26) are lost in its text; letters and numbers here follow its prose and ``docs/observers``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.injection import MAX_GAIN, stabilise
from duio_mesh.geometry.stability import Stability, stable_abscissa
from duio_mesh.geometry.staircase import detectability_decomposition, observability_decomposition
from duio_mesh.geometry.subspace import GeometryError, kernel, norm
from duio_mesh.synthesis.sampled import Local

WORST_CONDITION = 1e6
"""Singular values this far below the largest count as zero; LAPACK would go on and return a T of size 1e16."""


class Model(NamedTuple):
    """dx/dt = A x + B u + D f, y = C x + F v for one node (seed 004, (1))."""

    A: Array  # (n, n)
    B: Array  # (n, m)
    D: Array  # (n, q)
    C: Array  # (p, n)
    F: Array  # (p, r)


@dataclass(frozen=True)
class Separated:
    """x = U1 z1 + V2 z2 with z1 = C11^-1 w1 known at once and z2 free of the unknown input (seed 004, (6)).

    w1 = W1 y and w2 = W2 y carry no measurement noise; w1 = C11 z1, w2 = C22 z2 and
    dz1/dt = A11 z1 + A12 z2 + B1 u + D1 f, dz2/dt = A21 z1 + A22 z2 + B2 u.
    """

    W1: Array  # (q, p)
    W2: Array  # (p - r - q, p)
    U1: Array  # (n, q)
    V2: Array  # (n, n - q)
    C11: Array
    C22: Array
    A11: Array
    A12: Array
    A21: Array
    A22: Array
    B1: Array
    B2: Array
    D1: Array
    margin: float
    """Smallest singular value of C~ D relative to |C~| |D|; 0 violates Assumption 2.

    In the file's units, or where it is too small there, with rows of C and columns of D of length 1.
    """


def separate(model: Model, who: str, unknown: Sequence[str]) -> Separated:
    """The output transform and Algorithm 1 of seed 004. ``who`` and ``unknown`` (names) are for error texts.

    Raises DesignError when the noise channel has dependent columns, or when Assumption 2, rank(C~ D) = rank(D), fails
    in the units of the file and in those of ``_in_units`` alike.
    """
    q, F = model.D.shape[1], model.F
    noise = np.linalg.svd(F, compute_uv=False)
    if F.shape[1] > F.shape[0] or (noise.size and noise[-1] * WORST_CONDITION <= noise[0]):
        raise DesignError(
            f"{who}: the noise channel ({F.shape[0]} x {F.shape[1]}) must have independent columns; "
            f"its singular values are {_list(noise)}"
        )
    seen = _seen(model)
    if seen.holds:
        return _separated(model, seen)
    scaled, y, f = _in_units(model)
    seen = _seen(scaled)
    if not seen.holds:
        raise DesignError(_not_matched(who, unknown, seen.values, len(model.C), F.shape[1], q))
    s = _separated(scaled, seen)
    return replace(s, W1=s.W1 * y, W2=s.W2 * y, D1=s.D1 / f)


def _in_units(model: Model) -> tuple[Model, Array, Array]:
    """The model of diag(y) times the outputs and diag(1/f) times the unknown inputs, with y (p,) and f (q,).

    Rows of C and columns of D have length 1 there, so whether C~ D has full rank does not depend on the file's units;
    F is only read for its image, so its columns are brought to length 1 as well.
    """
    y, f = 1 / _lengths(model.C.T), 1 / _lengths(model.D)
    F = y[:, None] * model.F
    return model._replace(D=model.D * f, C=y[:, None] * model.C, F=F / _lengths(F)), y, f


def _lengths(M: Array) -> Array:
    """Lengths of the columns; 1 for a zero column."""
    lengths: Array = np.linalg.norm(M, axis=0)
    return np.where(lengths > 0, lengths, 1.0)


class _Seen(NamedTuple):
    """How the noise-free outputs Q y = C~ x see the unknown input."""

    Q: Array  # (p - r, p) orthonormal rows with Q F = 0
    U: Array  # left singular vectors of C~ D
    values: Array  # singular values of C~ D relative to |C~| |D|
    holds: bool  # Assumption 2


def _seen(model: Model) -> _Seen:
    F, q = model.F, model.D.shape[1]
    Q = kernel(F.T).T if F.shape[1] else np.eye(F.shape[0])
    Cb = Q @ model.C
    U, values, _ = np.linalg.svd(Cb @ model.D)
    size = norm(Cb) * norm(model.D)
    holds = len(Cb) >= q and (not q or bool(values[-1] * WORST_CONDITION > size))
    return _Seen(Q, U, values / (size or 1.0), holds)


def _separated(model: Model, seen: _Seen) -> Separated:
    """Algorithm 1 for a model that satisfies Assumption 2."""
    A, B, D, C, _ = model
    q, Q, U = D.shape[1], seen.Q, seen.U
    Cb = Q @ C
    S1, S2 = U[:, :q].T, U[:, q:].T
    U1 = np.linalg.svd(D)[0][:, :q]
    V2 = kernel(S1 @ Cb) if q else np.eye(A.shape[0])
    T = np.linalg.inv(np.hstack([U1, V2]))
    T1, T2 = T[:q], T[q:]
    return Separated(
        W1=S1 @ Q,
        W2=S2 @ Q,
        U1=U1,
        V2=V2,
        C11=S1 @ Cb @ U1,
        C22=S2 @ Cb @ V2,
        A11=T1 @ A @ U1,
        A12=T1 @ A @ V2,
        A21=T2 @ A @ U1,
        A22=T2 @ A @ V2,
        B1=T1 @ B,
        B2=T2 @ B,
        D1=T1 @ D,
        margin=float(seen.values[-1]) if q else 1.0,
    )


def _not_matched(who: str, unknown: Sequence[str], seen: NDArray[np.floating], p: int, r: int, q: int) -> str:
    rank = int(np.sum(seen * WORST_CONDITION > 1))
    return (
        f"{who}: Assumption 2 fails: rank(C~ D) = {rank}, but rank(D) = {q} unknown inputs ({', '.join(unknown)}). "
        f"Its {p} measurements leave {p - r} without noise; the singular values of C~ D relative to |C~| |D| (rows of "
        f"C and columns of D scaled to length 1) are {_list(seen)} and must exceed {1 / WORST_CONDITION:g}. Measure "
        "states that the unknown inputs drive directly."
    )


def _list(values: NDArray[np.floating]) -> str:
    return "[" + ", ".join(f"{v:.3g}" for v in values) + "]"


class RateError(DesignError):
    """No reliable gain moves the visible modes of a node as far left as asked for."""


class Split(NamedTuple):
    """z2 = T_d zd + T_u zu: what the node estimates alone and what it needs its neighbours for (seed 004, (7))."""

    Td: Array  # (n - q, n - q - nu)
    Tu: Array  # (n - q, nu)
    Au: Array  # (nu, nu)
    N: Array  # (n - q, p2) injection of w2 - C22 z2-hat, acts on Td only
    undetectable: NDArray[np.complex128]  # eigenvalues of Au
    own: NDArray[np.complex128]  # eigenvalues of A_d - N_d C_d


def split(s: Separated, sigma: float, rate: float, who: str, max_gain: float = MAX_GAIN) -> Split:
    """Hand the modes of (A22, C22) with Re >= -sigma that w2 does not show to the network, move the visible past -rate.

    Unobservable modes left of -sigma stay where they are: only the observable quotient is assigned. ``max_gain`` bounds
    the gain relative to |A| / |C| (``stabilise``).
    Raises RateError when the gain, DesignError when the subspaces cannot be computed reliably.
    """
    try:
        parts = detectability_decomposition(s.C22, s.A22, hidden_from(sigma))
        Td, Tu = parts.D, parts.U
        Ad, Cd = Td.T @ s.A22 @ Td, s.C22 @ Td
        visible = observability_decomposition(Cd, Ad).D
    except GeometryError as e:
        raise DesignError(f"{who}: observer.sigma = {sigma:g}: {e}") from None
    try:
        Nd = -visible @ stabilise(Cd @ visible, visible.T @ Ad @ visible, stable_abscissa(-rate), max_gain)
    except GeometryError as e:
        raise RateError(
            f"{who}: observer.rate = {rate:g}: its measurements see the visible modes too weakly for a reliable gain "
            f"that moves them left of -{rate:g} 1/s; a smaller rate may do ({e})"
        ) from None
    own = np.linalg.eigvals(Ad - Nd @ Cd).astype(np.complex128)
    return Split(Td, Tu, Tu.T @ s.A22 @ Tu, Td @ Nd, parts.eigenvalues, own)


def hidden_from(sigma: float) -> Stability:
    """The region left of -sigma; sigma = 0 keeps a distance from the axis, where rounding would decide."""
    return stable_abscissa(-max(sigma, 1e-6))


class Interval(NamedTuple):
    """dw1/dt = Psi w1 + Phi z2 + Bw u + G f, and p+ >= G f >= p- for f inside its bounds (seed 004, (14)-(16))."""

    Psi: Array  # (q, q)
    Phi: Array  # (q, n - q)
    Bw: Array  # (q, m)
    G: Array  # (q, q), invertible
    p_plus: Array  # (q,)
    width: Array  # (q,) pi = p+ - p-

    @property
    def amplification(self) -> float:
        """|G^-1 Phi|: f-hat - f = G^-1 Phi (z2 - z2-hat) once the differentiator has settled."""
        return norm(np.asarray(np.linalg.solve(self.G, self.Phi)))


def interval(s: Separated, low: Array, high: Array) -> Interval:
    """The equation of w1 and its bounds for low <= f <= high (q,)."""
    G = s.C11 @ s.D1
    above, below = np.maximum(G, 0), np.maximum(-G, 0)
    return Interval(
        Psi=s.C11 @ np.linalg.solve(s.C11.T, s.A11.T).T,
        Phi=s.C11 @ s.A12,
        Bw=s.C11 @ s.B1,
        G=G,
        p_plus=above @ high - below @ low,
        width=(above + below) @ (high - low),
    )


def local_observer(s: Separated, gains: Split, bounds: Interval, kappa: float) -> Local:
    """State [z2-hat; eta+], coupling push (n - q,) into z2-hat (seed 004, (8) and (15) with M = -kappa I)."""
    q, k = s.W1.shape[0], s.A22.shape[0]
    A21_w1 = np.linalg.solve(s.C11.T, s.A21.T).T @ s.W1
    Psi, Phi, Bw, _, p_plus, _ = bounds
    M = kappa * np.eye(q)
    return Local(
        A=np.block([[s.A22 - gains.N @ s.C22, np.zeros((k, q))], [Phi, -M]]),
        Y=np.vstack([A21_w1 + gains.N @ s.W2, (Psi + M) @ s.W1]),
        U=np.vstack([s.B2, Bw]),
        K=np.vstack([gains.Tu, np.zeros((q, gains.Tu.shape[1]))]),
        bias=np.concatenate([np.zeros(k), p_plus]),
    )
