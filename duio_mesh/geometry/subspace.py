"""Subspaces of R^n as orthonormal bases, and their algebra.

A subspace of dimension k is an (n, k) array with orthonormal columns; k = 0 is the zero space and k = n the whole one.

Every decision "is this singular value zero?" is ``sigma <= rtol * scale``. ``scale`` is the size that the matrix would
have if it were not singular: 1 for differences of orthonormal bases (then sigma is the sine of an angle between
subspaces), ||A||_2 for images under A. It is never the size of a matrix that is itself a difference, because a matrix
that consists of rounding errors has full rank relative to its own norm. Data that are printed with d digits have
errors of about 10^-d: either take them as exact (the default 1e-9) or give an rtol clearly above their error.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array

RTOL = 1e-9


class GeometryError(ValueError):
    """A geometric question without a numerically meaningful answer; the message is a sentence for the user."""


class Rank(NamedTuple):
    """A rank decision and how clear it was: ``kept`` and ``dropped`` are singular values relative to the scale."""

    rank: int
    kept: float  # the smallest that counted as nonzero; inf when none did
    dropped: float  # the largest that counted as zero; 0 when there was none

    def worst(self, other: Rank) -> Rank:
        """The later rank with the less clear margins of the two."""
        return Rank(other.rank, min(self.kept, other.kept), max(self.dropped, other.dropped))


CLEAR = Rank(0, np.inf, 0.0)
"""The margin of no decision at all; the neutral element of ``worst``."""


def as_matrix(name: str, M: Any, rows: int | None = None, columns: int | None = None) -> Array:
    """M as a finite float64 matrix with the given numbers of rows and columns (None: any). Raises GeometryError."""
    a = np.asarray(M, dtype=np.float64)
    want = ("any" if rows is None else rows, "any" if columns is None else columns)
    if a.ndim != 2 or (rows is not None and a.shape[0] != rows) or (columns is not None and a.shape[1] != columns):
        raise GeometryError(f"{name} has shape {a.shape}; expected a matrix of shape ({want[0]}, {want[1]})")
    if not np.isfinite(a).all():
        raise GeometryError(f"{name} holds NaN or infinity")
    return a


def as_pair(C: Any, A: Any) -> tuple[Array, Array]:
    """C (p, n) and A (n, n) as matrices that fit together. Raises GeometryError."""
    A = as_matrix("A", A)
    A = as_matrix("A", A, A.shape[0], A.shape[0])
    return as_matrix("C", C, columns=A.shape[0]), A


def norm(M: Array) -> float:
    """The largest singular value; 0 for an empty matrix."""
    return float(linalg.norm(M, 2)) if M.size else 0.0


def _svd(M: Array, rtol: float, scale: float | None) -> tuple[Array, Array, Rank]:
    """Left and right singular vectors (U full, V' full) and the rank of M."""
    rows, columns = M.shape
    if not M.size:
        return np.eye(rows), np.eye(columns), CLEAR
    U, sigma, Vh = linalg.svd(M)
    size = float(sigma[0]) if scale is None else scale
    r = int(np.count_nonzero(sigma > rtol * size))
    relative = sigma / size if size > 0 else sigma
    kept = float(relative[r - 1]) if r else np.inf
    dropped = float(relative[r]) if r < sigma.size else 0.0
    return U, Vh, Rank(r, kept, dropped)


def rank(M: Array, rtol: float = RTOL, scale: float | None = None) -> Rank:
    """The rank of M relative to ``scale`` (default its largest singular value), with the decisive singular values."""
    return _svd(M, rtol, scale)[2]


def image(M: Array, rtol: float = RTOL, scale: float | None = None) -> Array:
    """Im M: an orthonormal basis of the column space."""
    U, _, decided = _svd(M, rtol, scale)
    return U[:, : decided.rank]


orth = image


def kernel(M: Array, rtol: float = RTOL, scale: float | None = None) -> Array:
    """Ker M = {x : M x = 0}."""
    return kernel_with_margin(M, rtol, scale)[0]


def kernel_with_margin(M: Array, rtol: float = RTOL, scale: float | None = None) -> tuple[Array, Rank]:
    """Ker M and the rank decision behind it."""
    _, Vh, decided = _svd(M, rtol, scale)
    return Vh[decided.rank :].T, decided


def complement(V: Array) -> Array:
    """The orthogonal complement of V."""
    return kernel(V.T, scale=1.0)


def quotient(V: Array) -> Array:
    """The canonical projection X -> X/V: (n - k, n) with orthonormal rows and kernel V."""
    return complement(V).T


def residual(V: Array, M: Array) -> Array:
    """The part of M's columns outside V."""
    part = M - V @ (V.T @ M)
    return part - V @ (V.T @ part)  # twice: what is left of a nearly contained vector must be orthogonal to V


def add(V: Array, W: Array, rtol: float = RTOL, scale: float = 1.0) -> Array:
    """V + Im W, with V's basis as the first columns. W need not be a basis: ``scale`` is its size (1 for a basis)."""
    return add_with_margin(V, W, rtol, scale)[0]


def add_with_margin(V: Array, W: Array, rtol: float = RTOL, scale: float = 1.0) -> tuple[Array, Rank]:
    """V + Im W and the rank decision about the directions that W adds."""
    U, _, decided = _svd(residual(V, W), rtol, scale)
    R = U[:, : decided.rank]
    if decided.rank:
        R = linalg.qr(residual(V, R), mode="economic")[0]
    return np.hstack([V, R]), decided


def intersection(V: Array, W: Array, rtol: float = RTOL) -> Array:
    """V and W's common subspace: directions of V whose angle to W has a sine of at most rtol."""
    return V @ kernel(residual(W, V), rtol, scale=1.0)


def preimage(A: Array, V: Array, rtol: float = RTOL) -> Array:
    """A^-1 V = {x : A x in V}."""
    return kernel(residual(V, A), rtol, scale=norm(A))


def excess(V: Array, W: Array) -> float:
    """How far V sticks out of W: the sine of the largest angle of a vector of V to W. 0 when V is contained in W."""
    return min(1.0, norm(residual(W, V)))


def gap(V: Array, W: Array) -> float:
    """||P_V - P_W||_2: the sine of the largest principal angle, 1 when the dimensions differ, 0 when V = W."""
    return 1.0 if V.shape[1] != W.shape[1] else excess(V, W)


def contains(W: Array, V: Array, rtol: float = RTOL) -> bool:
    """Whether V is a subspace of W."""
    return excess(V, W) <= rtol


def unit_rows(C: Array, rounding: float = 0.0) -> Array:
    """C with every row that is not exactly zero scaled to length 1: the same kernel, without units.

    A row's length carries only its unit, so rows of data are never compared with each other: what looks negligible may
    be a quantity in large units. ``rounding`` is for rows that a computation with errors of that size, relative to the
    largest entry, has produced: shorter ones are dropped too.
    """
    largest: Array = np.abs(C).max(axis=1, initial=0.0)
    keep = largest > rounding * largest.max(initial=0.0)
    # by a power of 2 first, which changes no digit, so that the squares of tiny entries do not underflow
    rows: Array = np.ldexp(C[keep], -np.frexp(largest[keep])[1][:, None])
    unit: Array = rows / np.linalg.norm(rows, axis=1)[:, None]
    return unit


def unit_columns(B: Array, rounding: float = 0.0) -> Array:
    """B with every column that is not exactly zero scaled to length 1: same image, no units."""
    return unit_rows(B.T, rounding).T
