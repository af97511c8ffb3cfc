"""The errors of all nodes as one linear system, kept in blocks: products, spectral radius, stationary variances.

    s(k+1) = Phi s(k),   block (i, j) of Phi = F_i [i = j] - K_i R_i l_ij X_j

Up to DENSE rows Phi is formed and all its eigenvalues are computed. Beyond that only products are made, node by node
and arc by arc, and the largest eigenvalue comes from Arnoldi's method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.synthesis.sampled import Coupled, error_system

Say = Callable[[str], None]

DENSE = 500
"""Rows up to which all eigenvalues are computed (a second)."""
WANTED, BASIS, TOLERANCE, RESTARTS = 2, 120, 1e-9, 100
"""Arnoldi's method: eigenvalues, vectors before a restart, relative accuracy."""
HOPELESS = 3000
"""Rows from which all eigenvalues are not computed even when Arnoldi's method fails: that would take hours."""
FORGOTTEN, LONGEST = 1e-6, 20_000
"""A stationary covariance is summed until so little is missing, or given up after so many steps."""


class Stacked:
    """Phi of these nodes, in this order, coupled by ``laplacian`` (m, m)."""

    def __init__(self, nodes: Sequence[Coupled], laplacian: Array) -> None:
        self._nodes, self._laplacian, self._weights = tuple(nodes), laplacian, sparse.csr_array(laplacian)
        ends = np.cumsum([len(node.F) for node in nodes])
        self.at = [slice(int(end) - len(node.F), int(end)) for end, node in zip(ends, nodes, strict=True)]
        """Rows of every node."""
        self.size = int(ends[-1])

    def dense(self) -> Array:
        """Phi (size, size)."""
        return error_system(self._nodes, self._laplacian)

    def times(self, S: Array) -> Array:
        """Phi S for S (size, k)."""
        said = np.stack([node.X @ S[at] for node, at in zip(self._nodes, self.at, strict=True)])
        heard = (self._weights @ said.reshape(len(said), -1)).reshape(said.shape)
        parts = zip(self._nodes, self.at, heard, strict=True)
        return np.vstack([node.F @ S[at] - node.K @ (node.R @ mixed) for node, at, mixed in parts])

    def radius(self, say: Say = lambda _: None) -> float:
        """Spectral radius: of all eigenvalues, or, beyond DENSE rows, the largest that Arnoldi's method finds.

        The latter is an eigenvalue, so a lower bound; where the gains come with a norm, that is the upper one.
        """
        return largest_modulus(self.size, self.times, self.dense, say)

    def variances(self, entry: Array, say: Say = lambda _: None) -> Array | None:
        """(size,) diagonal of sum_k Phi^k W W' Phi'^k, W = ``entry`` (size, c), or None when it takes too long.

        What is missing in the end is estimated from the last factor between two terms.
        """
        total, last = np.sum(entry**2, axis=1), 0.0
        for k in range(1, LONGEST + 1):
            entry = self.times(entry)
            term = np.sum(entry**2, axis=1)
            total += term
            now = float(term.sum())
            left = now * now / max(last - now, 1e-300) if now < last else np.inf
            if left <= FORGOTTEN * float(total.sum()) or not now:
                return np.asarray(total)
            last = now
            if k % 50 == 0:
                say(f"variances under the noise, {k} steps, {left / float(total.sum()):.0e} still missing")
        return None


def largest_modulus(
    size: int, times: Callable[[Array], Array], dense: Callable[[], Array], say: Say = lambda _: None
) -> float:
    """Largest modulus of an eigenvalue of a real operator: ``times`` (size, k) -> (size, k), ``dense`` forms it.

    Raises DesignError when Arnoldi's method fails on more rows than ``dense`` is for.
    """
    if size <= DENSE:
        return spectral_radius(dense())
    done = 0

    def product(x: Array) -> Array:
        nonlocal done
        done += 1
        if done % 100 == 1:
            say(f"largest eigenvalues of {size} by Arnoldi's method, {done - 1} products")
        return times(x.reshape(size, 1)).ravel()

    start = np.random.default_rng(0).standard_normal(size)
    try:
        values = eigs(
            LinearOperator((size, size), matvec=product, dtype=np.float64),
            k=WANTED,
            ncv=BASIS,
            which="LM",
            v0=start,
            tol=TOLERANCE,
            maxiter=RESTARTS,
            return_eigenvectors=False,
        )
    except ArpackNoConvergence:
        if size > HOPELESS:
            raise DesignError(
                f"the spectral radius of a recursion with {size} rows was not found: Arnoldi's method did not separate "
                f"its largest eigenvalues in {done} products, and all eigenvalues would take hours"
            ) from None
        say(f"all {size} eigenvalues, because Arnoldi's method does not separate the largest")
        return spectral_radius(dense())
    return float(np.abs(values).max())
