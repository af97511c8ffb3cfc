"""The matrix whose largest eigenvalue the coupling gains g minimise (seed 000, (38) and (49)), in blocks.

    S(g, t) = t I - A'A + Theta'A + A'Theta - Theta'Theta / c >= 0,   c = 1 (norm), c = t (paper),   t = 1 + beta_u

with A = diag(A_iu) and Theta(g) = U' (diag(g) L x I_n) U. Nothing of size N x N is needed for a product: Theta X is
made node by node and arc by arc, in about 2 n N multiplications per column of X (N, k).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from duio_mesh.arrays import Array

Criterion = Literal["paper", "norm"]

DENSE = 150
"""Up to so many rows all eigenvectors are computed: faster than Lanczos."""


class Reduced(NamedTuple):
    """X'S(g, t)X = t I - a + sum_i g_i b_i - sum_i g_i^2 c_i / (1 or t) for orthonormal X (N, k)."""

    a: Array  # (k, k)
    b: Array  # (m, k, k)
    c: Array  # (m, k, k)
    criterion: Criterion

    @property
    def k(self) -> int:
        """Columns of X."""
        return len(self.a)

    def only(self, free: NDArray[np.bool_]) -> Reduced:
        """With the other g_i = 0."""
        return self._replace(b=self.b[free], c=self.c[free])


class Pencil:
    """S(g, t) for m nodes on one graph.

    ``A``: A_iu (nu_i, nu_i) of every node, ``U``: U_i (n, nu_i), ``laplacian`` (m, m).
    """

    def __init__(self, A: Sequence[Array], U: Sequence[Array], laplacian: Array, criterion: Criterion) -> None:
        self.criterion: Criterion = criterion
        self.sizes = np.array([block.shape[1] for block in U])
        self.m, self.N = len(U), int(self.sizes.sum())
        ends = np.cumsum(self.sizes)
        self._at = [slice(int(end - size), int(end)) for end, size in zip(ends, self.sizes, strict=True)]
        self._A, self._U, self._laplacian = tuple(A), tuple(U), sparse.csr_array(laplacian)
        self._hears = [np.flatnonzero(row) for row in laplacian]
        self.active = np.array([bool(self._blocks(i)) for i in range(self.m)])
        """(m,) nodes whose gain has an effect: the others have no undetectable part, or hear nobody."""

    @cached_property
    def T(self) -> Array:
        """(N, N): Theta(g) = diag(g_i I) T. For small systems."""
        return self.heard(np.eye(self.N))

    def phi(self, g: Array) -> Array:
        """(N, N): Phi_u = A - Theta of (30). For small systems."""
        return np.asarray(linalg.block_diag(*self._A) - self._gains(g) * self.T)

    def drive(self, g: Array, X: Array) -> Array:
        """Phi_u X."""
        return self._times_A(X) - self._gains(g) * self.heard(X)

    def heard(self, X: Array) -> Array:
        """T X: what every node hears of the columns of X (N, k), in the coordinates of its own U_i."""
        return self._exchanged(X, self._laplacian)

    def leading(self, g: Array, count: int, start: Array) -> tuple[float, Array]:
        """The least t with S(g, t) >= 0 as far as Lanczos' method sees, and orthonormal x (N, count) that show it.

        ``start`` (N,) is where that method starts.
        """
        if self.criterion == "norm":
            size, product = self.N, lambda X: self._drive_transposed(g, self.drive(g, X))
        else:  # t is the largest eigenvalue of [A'A - A'Theta - Theta'A, Theta'; Theta, 0]
            size, product = 2 * self.N, lambda X: self._paper_product(g, X)
            start = np.append(start, np.zeros(self.N))
        values, vectors = _largest(product, size, count, start)
        basis, triangle = np.linalg.qr(vectors[: self.N])
        return max(float(values[-1]), 0.0), basis[:, np.abs(np.diag(triangle)) > 1e-9]

    def reduced(self, X: Array) -> Reduced:
        """On the columns of X (N, k), orthonormal."""
        AX, TX = self._times_A(X), self.heard(X)
        b = np.array([AX[at].T @ TX[at] for at in self._at])
        c = np.array([TX[at].T @ TX[at] for at in self._at])
        return Reduced(AX.T @ AX, b + b.transpose(0, 2, 1), c, self.criterion)

    def holds(self, g: Array, t: float) -> bool:
        """Whether S(g, t) > 0, proven by its Cholesky factor, which is made of the blocks that are not zero.

        Two nodes have a block in S when somebody hears both (every node hears itself).
        """
        S: dict[tuple[int, int], Array] = {}
        for j, size in enumerate(self.sizes):
            S[j, j] = t * np.eye(size)
        c = t if self.criterion == "paper" else 1.0
        for i, own in enumerate(self._A):
            theta = {j: float(g[i]) * block for j, block in self._blocks(i).items()}
            if self.criterion == "norm":
                theta[i] = theta.get(i, 0.0) - own  # -Phi_u instead of Theta: its square has all three terms
            else:
                S[i, i] -= own.T @ own
                for j, block in theta.items():
                    _add(S, i, j, own.T @ block)
                    _add(S, j, i, block.T @ own)
            for j, left in theta.items():
                for k, right in theta.items():
                    _add(S, j, k, -left.T @ right / c)
        return _positive(S, self.m)

    def _blocks(self, i: int) -> dict[int, Array]:
        """T_ij = l_ij U_i'U_j that are not zero."""
        found = {}
        if self.sizes[i]:
            for j in map(int, self._hears[i]):
                block = float(self._laplacian[i, j]) * self._U[i].T @ self._U[j]
                if block.any():
                    found[j] = block
        return found

    def _gains(self, g: Array) -> Array:
        return np.repeat(g, self.sizes)[:, None]

    def _paper_product(self, g: Array, Z: Array) -> Array:
        X, Y = Z[: self.N], Z[self.N :]
        AX, gains = self._times_A(X), self._gains(g)
        theta = gains * self.heard(X)
        upper = self._transposed_A(AX - theta) + self._transposed_T(gains * (Y - AX))
        return np.vstack([upper, theta])

    def _drive_transposed(self, g: Array, Y: Array) -> Array:
        return self._transposed_A(Y) - self._transposed_T(self._gains(g) * Y)

    def _times_A(self, X: Array) -> Array:
        return np.vstack([block @ X[at] for block, at in zip(self._A, self._at, strict=True)])

    def _transposed_A(self, X: Array) -> Array:
        return np.vstack([block.T @ X[at] for block, at in zip(self._A, self._at, strict=True)])

    def _transposed_T(self, X: Array) -> Array:
        return self._exchanged(X, self._laplacian.T)

    def _exchanged(self, X: Array, weights: sparse.csr_array) -> Array:
        said = np.stack([block @ X[at] for block, at in zip(self._U, self._at, strict=True)])
        mixed = (weights @ said.reshape(self.m, -1)).reshape(said.shape)
        return np.vstack([block.T @ part for block, part in zip(self._U, mixed, strict=True)])


def _largest(
    product: Callable[[Array], Array], size: int, count: int, start: Array
) -> tuple[NDArray[np.float64], Array]:
    """The largest eigenvalues of a symmetric operator, ascending, and their vectors."""
    operator = LinearOperator((size, size), matvec=lambda x: product(x.reshape(size, 1)).ravel(), matmat=product)
    if size > DENSE:
        ncv = min(size, max(3 * count, 40))
        try:
            values, vectors = eigsh(operator, k=count, which="LA", v0=start, ncv=ncv, tol=1e-6)
            return values, vectors
        except ArpackNoConvergence:
            pass  # eigenvalues that lie very close; all of them, then
    values, vectors = linalg.eigh(operator @ np.eye(size))
    return values[-count:], vectors[:, -count:]


def _add(S: dict[tuple[int, int], Array], i: int, j: int, block: Array) -> None:
    S[i, j] = S[i, j] + block if (i, j) in S else block


def _positive(S: dict[tuple[int, int], Array], m: int) -> bool:
    """Block Cholesky elimination of the symmetric S, in place; only the nodes that still have a block with k count."""
    for k in range(m):
        below = sorted(i for i, j in S if j == k and i > k)
        try:
            L = linalg.cholesky(S[k, k], lower=True, check_finite=False)
        except linalg.LinAlgError:
            return False
        solved = {i: linalg.solve_triangular(L, S[i, k].T, lower=True, check_finite=False) for i in below}
        for i in below:
            for j in below:
                if j <= i:
                    _add(S, i, j, -solved[i].T @ solved[j])
        for i in below:
            del S[i, k]
    return True
