"""Diffusive gains g_i of the undetectable parts (seed 000, section 5.3).

    e_u(k+1) = Phi_u e_u(k) + ...,   Phi_u = A_u - Theta(g),   Theta(g) = U' (diag(g) L x I_n) U          (30), (42)

Node i enters Theta only in its own rows: Theta(g) = sum_i g_i J_i T_i with T_i = U_i' (row i of L x I_n) U.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.synthesis.eigenvalue import Say, minimise_largest_eigenvalue
from duio_mesh.synthesis.pencil import Criterion, Pencil


class Undetectable(NamedTuple):
    """The undetectable part of one node."""

    A: Array  # (nu, nu), A_iu of (14)
    U: Array  # (n, nu), orthonormal


class Coupling(NamedTuple):
    """Gains of a group of nodes and how far they contract e_u' e_u in a step."""

    g: Array  # (m,), 0 where g_i has no effect
    beta: float  # V(k+1) - V(k) <= beta V(k)
    lower: float  # no g has a smaller beta in the same criterion
    norm: float  # ||Phi_u||_2
    pencil: Pencil  # criterion norm

    @property
    def phi(self) -> Array:
        """(N, N), Phi_u."""
        return self.pencil.phi(self.g)


def couple(
    parts: Sequence[Undetectable], laplacian: Array, criterion: Criterion, say: Say = lambda _: None
) -> Coupling:
    """The g that minimises beta_u for these nodes and the rows and columns (m, m) of their Laplacian.

    ``paper``: (38)-(39) literally. Its Schur complement with t = 1 + beta is

        A_u'A_u - A_u'Theta - Theta'A_u + Theta'Theta / t <= t I,

    while (49) has Theta'Theta without 1 / t: (39) is conservative for beta < 0.
    ``norm``: (49) exactly, beta = ||A_u - Theta(g)||_2^2 - 1.
    (40), beta_u <= 0, is not imposed: the caller tests the sign, which also says by how much it fails.
    Without any undetectable part Phi_u is empty, its norm 0 and beta = -1. Raises DesignError as the solver does.
    """
    best = minimise_largest_eigenvalue([pencil_of(parts, laplacian, criterion)], say)
    return coupling(best.g, best.value - 1, best.lower - 1, pencil_of(parts, laplacian, "norm"))


def coupling(g: Array, beta: float | None, lower: float, pencil: Pencil) -> Coupling:
    """With the norm of Phi_u computed; ``beta`` None: what that norm gives."""
    square = pencil.leading(g, min(3, pencil.N), np.ones(pencil.N))[0] if pencil.N else 0.0
    return Coupling(g, square - 1 if beta is None else beta, lower, float(np.sqrt(square)), pencil)


def pencil_of(parts: Sequence[Undetectable], laplacian: Array, criterion: Criterion) -> Pencil:
    """The matrix of ``couple``."""
    return Pencil([part.A for part in parts], [part.U for part in parts], laplacian, criterion)
