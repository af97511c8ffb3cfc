"""Node-wise observability and detectability decompositions (seed 000, (11)-(15)) without powers of A.

The textbook route, the kernel of [C; CA; ...; CA^(n-1)], loses all digits for n of about 30. Here the unobservable
subspace is found by orthogonal steps V <- Ker C, V <- V intersected with A^-1 V, each one singular value decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.geometry.stability import Stability, split_spectrum
from duio_mesh.geometry.subspace import (
    RTOL,
    Rank,
    add,
    as_pair,
    complement,
    kernel_with_margin,
    norm,
    residual,
    unit_rows,
)

_UNCLEAR = 1e-2  # a staircase that kept a smaller singular value than this is checked eigenvalue by eigenvalue


@dataclass(frozen=True)
class Decomposition:
    """R^n = D + U, [D U] orthogonal, U invariant under A and inside Ker C (seed 000, (11)-(15)).

    In these coordinates A = [[A_d, 0], [A_r, A_u]] and C = [C_d, 0].
    """

    D: Array  # (n, n - nu) basis of the complement: observable or detectable directions
    U: Array  # (n, nu) basis of the unobservable or undetectable subspace
    eigenvalues: NDArray[np.complex128]  # (nu,) of A restricted to U
    rank: (
        Rank  # nu, and the least clear singular values of all steps, relative to ||A||_2 (first step: rows of length 1)
    )

    @property
    def nu(self) -> int:
        """Dimension of U."""
        return int(self.U.shape[1])


def unobservable_with_margin(C: Array, A: Array, rtol: float) -> tuple[Array, Rank]:
    """``unobservable_subspace``, and how clear its rank decisions were."""
    C, size = unit_rows(C, rtol), norm(A)
    V, margin = kernel_with_margin(C, rtol, scale=1.0)
    while V.shape[1]:
        inside, decided = kernel_with_margin(residual(V, A @ V), rtol, scale=size)
        margin = margin.worst(decided)
        if inside.shape[1] == V.shape[1]:
            break
        V = V @ inside
    while margin.kept < _UNCLEAR and V.shape[1] < A.shape[0]:
        D = complement(V)
        modes = _hidden_modes(C @ D, D.T @ A @ D, rtol, size)
        if not modes.shape[1]:
            break
        V = np.hstack([V, D @ modes])
    return V, margin._replace(rank=V.shape[1])


def _hidden_modes(C: Array, A: Array, rtol: float, size: float) -> Array:
    """The span of A's eigenvectors inside Ker C, by the Popov-Belevitch-Hautus matrix at every eigenvalue.

    Rounding grows along a staircase of many steps (a 7 x 7 grid seen from two corners takes 13) until it passes for a
    small singular value: then modes that no output sees are missed. Eigenvectors of a normal A do not suffer from that.
    (The other way round, they are useless for defective eigenvalues, where the staircase is exact.)
    """
    n, unit = A.shape[0], size or 1.0
    V = np.zeros((n, 0))
    for value in np.linalg.eigvals(A):
        if value.imag < 0:
            continue
        shift = value if value.imag else value.real  # real arithmetic is four times faster
        tall = np.vstack([(A - shift * np.eye(n)) / unit, C])
        _, sigma, Vh = np.linalg.svd(tall, full_matrices=False)
        hidden = Vh[np.flatnonzero(sigma <= rtol)].conj().T
        V = add(V, np.hstack([hidden.real, hidden.imag]), rtol)
    return V


def unobservable_subspace(C: Array, A: Array, rtol: float = RTOL) -> Array:
    """<Ker C | A>: the largest A-invariant subspace inside Ker C. C is (p, n), A is (n, n).

    ``rtol`` is relative to 1 for C (rows scaled to length 1) and to ||A||_2 for A.
    Raises GeometryError for wrong shapes or values that are not finite.
    """
    C, A = as_pair(C, A)
    return unobservable_with_margin(C, A, rtol)[0]


def observability_decomposition(C: Array, A: Array, rtol: float = RTOL) -> Decomposition:
    """D and U with U the unobservable subspace of (C, A). Arguments and errors as ``unobservable_subspace``."""
    C, A = as_pair(C, A)
    U, decided = unobservable_with_margin(C, A, rtol)
    return Decomposition(complement(U), U, np.linalg.eigvals(U.T @ A @ U).astype(np.complex128), decided)


def detectability_decomposition(C: Array, A: Array, stability: Stability, rtol: float = RTOL) -> Decomposition:
    """D and U with U the undetectable subspace of (C, A): the unobservable modes that ``stability`` calls bad.

    The bad modes are split off by the ordered real Schur form of A restricted to the unobservable subspace.
    Arguments and errors as ``unobservable_subspace``; also GeometryError when good and bad modes cannot be separated.
    """
    C, A = as_pair(C, A)
    V, decided = unobservable_with_margin(C, A, rtol)
    Z, bad, _ = split_spectrum(V.T @ A @ V, stability)
    U = V @ Z
    return Decomposition(complement(U), U, bad, decided._replace(rank=U.shape[1]))
