"""Diffusive gains g_i of the undetectable parts (seed 000, section 5.3).

    e_u(k+1) = Phi_u e_u(k) + ...,   Phi_u = A_u - Theta(g),   Theta(g) = U' (diag(g) L x I_n) U          (30), (42)

Node i enters Theta only in its own rows: Theta(g) = sum_i g_i J_i T_i with T_i = U_i' (row i of L x I_n) U.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from duio_mesh.arrays import Array
from duio_mesh.geometry.subspace import norm
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
    phi: Array  # (N, N), Phi_u


def couple(
    parts: Sequence[Undetectable], laplacian: Array, criterion: Criterion, say: Say = lambda _: None
) -> Coupling:
    """The g that minimises beta_u for these nodes and the rows and columns (m, m) of their Laplacian.

    ``paper``: (38)-(39) literally. Its Schur complement with gamma = 1 + beta is

        A_u'A_u - A_u'Theta - Theta'A_u + Theta'Theta / gamma <= gamma I,

    while (49) has Theta'Theta without 1/gamma: (39) is conservative for beta < 0.
    ``norm``: (49) exactly, beta = ||A_u - Theta(g)||_2^2 - 1.
    (40), beta_u <= 0, is not imposed: the caller tests the sign, which also says by how much it fails.
    Without any undetectable part Phi_u is empty, its norm 0 and beta = -1. Raises DesignError as the solver does.
    """
    pencil = Pencil([part.A for part in parts], [part.U for part in parts], laplacian, criterion)
    best = minimise_largest_eigenvalue([pencil], say)
    phi = pencil.phi(best.x)
    return Coupling(best.x, _beta(best.value, criterion), _beta(best.lower, criterion), norm(phi), phi)


def _beta(gamma: float, criterion: Criterion) -> float:
    """beta_u of a value of the pencil: gamma is ||Phi_u||_2 (norm) or 1 + beta_u (paper)."""
    return max(gamma, 0.0) ** 2 - 1 if criterion == "norm" else gamma - 1
