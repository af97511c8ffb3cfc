"""The matrix whose largest eigenvalue the coupling gains g minimise (seed 000, (38) and (49)), in blocks.

    S(g, gamma) = gamma I - [F11, R'; R, 0],       R = Phi_u = A - Theta(g),  F11 = 0                           (norm)
                                                   R = Theta(g),  F11 = A'A - A'Theta - Theta'A               (paper)

of size 2N with Theta(g) = sum_i g_i J_i J_i'T, T = U'(L x I_n) U. Its lower right block is gamma I, so everything that
a barrier method asks of S^-1 follows from the N x N Schur complement S / gamma I = W^-1, and every product with T is
made node by node and arc by arc: about 2 n N multiplications per column instead of N^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy import linalg, sparse

from duio_mesh.arrays import Array
from duio_mesh.geometry.subspace import norm

Criterion = Literal["paper", "norm"]


class Factored(NamedTuple):
    """S at one point."""

    g: Array  # (m,)
    gamma: float
    log_det: float  # -inf when S is not positive definite
    L: Array  # (N, N) lower Cholesky factor of W^-1


class Pencil:
    """S(g, gamma) for m nodes on one graph.

    ``A``: A_iu (nu_i, nu_i) of every node, ``U``: U_i (n, nu_i), ``laplacian`` (m, m).
    """

    def __init__(self, A: Sequence[Array], U: Sequence[Array], laplacian: Array, criterion: Criterion) -> None:
        self.criterion: Criterion = criterion
        self.sizes = np.array([block.shape[1] for block in U])
        self.N = int(self.sizes.sum())
        ends = np.cumsum(self.sizes)
        self._at = [slice(int(end - size), int(end)) for end, size in zip(ends, self.sizes, strict=True)]
        self._A, self._U, self._laplacian = tuple(A), tuple(U), sparse.csr_array(laplacian)
        self.A = linalg.block_diag(*A)
        stacked = np.hstack(U)
        self.T = np.repeat(np.repeat(laplacian, self.sizes, axis=0), self.sizes, axis=1) * (stacked.T @ stacked)
        self._square = self.A.T @ self.A
        self.active = np.array([self.T[at].any() for at in self._at], dtype=bool)
        """(m,) nodes whose gain has an effect: the others have no undetectable part, or hear nobody."""

    def rows(self, g: Array, M: Array) -> Array:
        """diag(g_i I) M."""
        return np.asarray(np.repeat(g, self.sizes)[:, None] * M)

    def phi(self, g: Array) -> Array:
        """(N, N): Phi_u of (30)."""
        return np.asarray(self.A - self.rows(g, self.T))

    def value(self, g: Array) -> float:
        """The least gamma with S >= 0: ||Phi_u||_2 (norm), 1 + lambda_max of M_g of (41) (paper)."""
        if self.criterion == "norm":
            return norm(self.phi(g))
        Theta = self.rows(g, self.T)
        cross = self.A.T @ Theta
        F = np.block([[self._square - cross - cross.T, Theta.T], [Theta, np.zeros_like(Theta)]])
        return float(linalg.eigvalsh(F, subset_by_index=(len(F) - 1, len(F) - 1))[0])

    def reach(self, gamma: float) -> Array:
        """(m,): |g_i| is at most this wherever the value is at most gamma; infinite where g_i has no effect here.

        ||Theta|| <= gamma + ||A|| (norm), or, completing the square in the Schur complement, ||Theta - gamma A||^2 <=
        gamma^2 + gamma (gamma - 1) ||A||^2 (paper).
        """
        size = norm(self.A)
        if self.criterion == "norm":
            Theta = gamma + size
        else:
            Theta = gamma * size + np.sqrt(gamma**2 + max(0.0, gamma * (gamma - 1)) * size**2)
        own = np.array([norm(self.T[at]) if active else 0.0 for at, active in zip(self._at, self.active, strict=True)])
        return np.asarray(np.divide(Theta, own, out=np.full(len(own), np.inf), where=own > 0))

    def factor(self, g: Array, gamma: float) -> Factored:
        """S at g and gamma."""
        if not gamma > 0:
            return Factored(g, gamma, -np.inf, self.A)
        if self.criterion == "norm":
            phi = self.phi(g)
            schur = -(phi.T @ phi) / gamma
        else:
            Theta = self.rows(g, self.T)
            cross = self._transposed_A(Theta)
            schur = cross + cross.T - self._square - Theta.T @ Theta / gamma
        schur[np.diag_indices(self.N)] += gamma
        try:
            L = linalg.cholesky(schur, lower=True, overwrite_a=True, check_finite=False)
        except linalg.LinAlgError:
            return Factored(g, gamma, -np.inf, schur)
        return Factored(g, gamma, float(2 * np.log(np.diag(L)).sum() + self.N * np.log(gamma)), L)

    def derivatives(self, at: Factored) -> tuple[Array, Array]:
        """Gradient (m + 1,) and Hessian (m + 1, m + 1) of -log det S in (g, gamma).

        With P = [B; s I] and Q = [T'; 0], B = 0 and s = -1 (norm) or B = -A' and s = 1 (paper), dS/dg_i is minus the
        symmetric product of the columns of node i; G = S^-1 = [W, K'; K, (I + K R') / gamma].
        """
        g, gamma, _, L = at
        W = _inverse(L)
        TW, AW = self._times_T(W), self._times_A(W)
        own = np.eye(self.N) / gamma
        if self.criterion == "norm":
            sign, K = -1.0, (AW - self.rows(g, TW)) / gamma
            TK = self._times_T(K.T)
            MK = (self._times_A(K.T) - self.rows(g, TK)) / gamma
            MW, TMW, PGP, G22 = K, TK, own + MK, own + MK
        else:  # M = A - Theta / gamma
            sign, K = 1.0, self.rows(g, TW) / gamma
            TK, MW = self._times_T(K.T), AW - K
            TMW = self._times_A(TW.T).T - TK
            MK = self._times_A(K.T) - self.rows(g, TK) / gamma
            PGP = own + self._times_A(MW.T) - self.rows(g, TMW) / gamma
            G22 = own + self.rows(g, TK) / gamma
        QGQ = self._times_T(TW.T)
        trace = float(np.trace(W) + np.trace(G22))
        square = float(np.sum(W * W) + 2 * np.sum(K * K) + np.sum(G22 * G22))
        gradient = np.append(-2 * self._sums(np.diag(TMW)), -trace)
        cross = 2 * self._sums(np.sum(MW * TW, axis=1) - np.sum((sign * own - MK) * TK, axis=1))
        by_node = 2 * self._sums(self._sums(PGP * QGQ + TMW * TMW.T).T)
        return gradient, np.block([[by_node, cross[:, None]], [cross[None, :], np.array([[square]])]])

    def _sums(self, M: Array) -> Array:
        """Sums of the rows (entries) of every node, (m, ...)."""
        return np.array([M[at].sum(axis=0) for at in self._at])

    def _times_A(self, M: Array) -> Array:
        return np.vstack([block @ M[at] for block, at in zip(self._A, self._at, strict=True)])

    def _transposed_A(self, M: Array) -> Array:
        return np.vstack([block.T @ M[at] for block, at in zip(self._A, self._at, strict=True)])

    def _times_T(self, M: Array) -> Array:
        """T M: what every node hears of the columns of M, in the coordinates of its own U_i."""
        said = np.stack([block @ M[at] for block, at in zip(self._U, self._at, strict=True)])
        heard = (self._laplacian @ said.reshape(len(said), -1)).reshape(said.shape)
        return np.vstack([block.T @ part for block, part in zip(self._U, heard, strict=True)])


def _inverse(L: Array) -> Array:
    """(L L')^-1."""
    lower, info = linalg.lapack.dpotri(L, lower=1)
    if info:
        raise linalg.LinAlgError("a Cholesky factor with a zero on its diagonal")
    return np.asarray(np.tril(lower) + np.tril(lower, -1).T)
