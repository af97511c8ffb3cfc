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
    as_pair,
    complement,
    kernel_with_margin,
    norm,
    residual,
    unit_rows,
)


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


def _unobservable(C: Array, A: Array, rtol: float) -> tuple[Array, Rank]:
    V, margin = kernel_with_margin(unit_rows(C, rtol), rtol, scale=1.0)
    size = norm(A)
    while V.shape[1]:
        inside, decided = kernel_with_margin(residual(V, A @ V), rtol, scale=size)
        margin = margin.worst(decided)
        if inside.shape[1] == V.shape[1]:
            break
        V = V @ inside
    return V, margin._replace(rank=V.shape[1])


def unobservable_subspace(C: Array, A: Array, rtol: float = RTOL) -> Array:
    """<Ker C | A>: the largest A-invariant subspace inside Ker C. C is (p, n), A is (n, n).

    ``rtol`` is relative to 1 for C (rows scaled to length 1) and to ||A||_2 for A.
    Raises GeometryError for wrong shapes or values that are not finite.
    """
    C, A = as_pair(C, A)
    return _unobservable(C, A, rtol)[0]


def observability_decomposition(C: Array, A: Array, rtol: float = RTOL) -> Decomposition:
    """D and U with U the unobservable subspace of (C, A). Arguments and errors as ``unobservable_subspace``."""
    C, A = as_pair(C, A)
    U, decided = _unobservable(C, A, rtol)
    return Decomposition(complement(U), U, np.linalg.eigvals(U.T @ A @ U).astype(np.complex128), decided)


def detectability_decomposition(C: Array, A: Array, stability: Stability, rtol: float = RTOL) -> Decomposition:
    """D and U with U the undetectable subspace of (C, A): the unobservable modes that ``stability`` calls bad.

    The bad modes are split off by the ordered real Schur form of A restricted to the unobservable subspace.
    Arguments and errors as ``unobservable_subspace``; also GeometryError when good and bad modes cannot be separated.
    """
    C, A = as_pair(C, A)
    V, decided = _unobservable(C, A, rtol)
    Z, bad, _ = split_spectrum(V.T @ A @ V, stability)
    U = V @ Z
    return Decomposition(complement(U), U, bad, decided._replace(rank=U.shape[1]))
