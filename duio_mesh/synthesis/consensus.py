"""Diffusive gains g_i of the undetectable parts (seed 000, section 5.3).

    e_u(k+1) = Phi_u e_u(k) + ...,   Phi_u = A_u - Theta(g),   Theta(g) = U' (diag(g) L x I_n) U          (30), (42)

Node i enters Theta only in its own rows: Theta(g) = sum_i g_i J_i T_i with T_i = U_i' (row i of L x I_n) U.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.geometry.subspace import norm
from duio_mesh.synthesis.eigenvalue import Optimum, Pencil, minimise_largest_eigenvalue

Criterion = Literal["paper", "norm"]


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


def couple(parts: Sequence[Undetectable], laplacian: Array, criterion: Criterion) -> Coupling:
    """The g that minimises beta_u for these nodes and the rows and columns (m, m) of their Laplacian.

    ``paper``: (38)-(39) literally. Its Schur complement with gamma = 1 + beta is

        A_u'A_u - A_u'Theta - Theta'A_u + Theta'Theta / gamma <= gamma I,

    while (49) has Theta'Theta without 1/gamma: (39) is conservative for beta < 0.
    ``norm``: (49) exactly, beta = ||A_u - Theta(g)||_2^2 - 1.
    (40), beta_u <= 0, is not imposed: the caller tests the sign, which also says by how much it fails.
    Without any undetectable part Phi_u is empty, its norm 0 and beta = -1. Raises DesignError as the solver does.
    """
    sizes = [part.U.shape[1] for part in parts]
    U, Au = np.hstack([part.U for part in parts]), linalg.block_diag(*[part.A for part in parts])
    # rows of node i: l_ij U_i' U_j for all j. Theta(g) is this matrix with node i's rows times g_i
    theta = np.repeat(np.repeat(laplacian, sizes, axis=0), sizes, axis=1) * (U.T @ U)
    owner = np.repeat(np.arange(len(parts)), sizes)
    free = [i for i in range(len(parts)) if theta[owner == i].any()]  # others have no U_i or hear nobody: g_i = 0
    g, beta, lower = np.zeros(len(parts)), -1.0, -1.0
    if owner.size:
        own = np.isin(owner, free)
        pencil = _pencil(Au, theta, own, tuple(sizes[i] for i in free), criterion)
        best: Optimum = minimise_largest_eigenvalue(pencil)
        g[free] = best.x
        beta, lower = best.value, best.lower
        if criterion == "norm":
            beta, lower = beta**2 - 1, max(lower, 0.0) ** 2 - 1
    phi = Au - np.repeat(g, sizes)[:, None] * theta
    return Coupling(g, beta, lower, norm(phi), phi)


def _pencil(Au: Array, theta: Array, own: NDArray[np.bool_], sizes: tuple[int, ...], criterion: Criterion) -> Pencil:
    """The matrix whose largest eigenvalue is beta_u (paper: M_g of (41)) or ||Phi_u||_2 (norm).

    With P_i = [-A_u' J_i; J_i] and Q_i = [T_i'; 0] the sum of g_i (P_i Q_i' + Q_i P_i') is [[-A_u'Theta - Theta'A_u,
    Theta'], [Theta, 0]]; with P_i = [0; -J_i] it is [[0, -Theta'], [-Theta, 0]]. Q's zero rows are not stored.
    """
    N = len(Au)
    I, J, zero = np.eye(N), np.eye(N)[:, own], np.zeros((N, N))
    Q = theta[own].T
    if criterion == "paper":
        return Pencil(linalg.block_diag(Au.T @ Au - I, -I), np.vstack([-Au.T @ J, J]), Q, sizes)
    return Pencil(np.block([[zero, Au.T], [Au, zero]]), np.vstack([0 * J, -J]), Q, sizes)
