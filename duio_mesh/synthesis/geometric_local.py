"""One node of seed 003: what it can follow alone (X/W_g*), what it needs its neighbours for, and its local observer."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.injection import reduced_observer
from duio_mesh.geometry.invariant import InputStructure, unknown_input_structure
from duio_mesh.geometry.stability import stable_abscissa
from duio_mesh.geometry.subspace import GeometryError, intersection, kernel, quotient, rank
from duio_mesh.synthesis.sampled import Coupled, Local, Step


class LocalUio(NamedTuple):
    """dz/dt = local(z, y, u) + K push, x-hat = X z + F y, push = chi R d + gamma sign(R d).

    d is the weighted sum of the neighbours' estimates minus the own one.
    N1, rank(C B_u) = rank(B_u): z follows P x, X = E, R = V' (seed 003, (19)); no sign term, and no coupling at all
    when V is empty, which is the centralised observer (9). N2: z = x-hat, R = W_g' (20).
    """

    group: Literal["N1", "N2"]
    structure: InputStructure
    L: Array  # (n, p)
    local: Local
    X: Array  # (n, k)
    F: Array  # (n, p)
    R: Array  # (c, n)
    own: NDArray[np.complex128]  # eigenvalues of A + L C on X/W_g
    hidden: int  # dim of W_g and Ker C: 0 when the node needs nobody (Lemma 2)
    inner: Array
    """A + L C on V (N1) or on W_g (N2): its block of A_L in (22)."""

    def coupled(self, chi: float, slope: float = 0.0, step: Step | None = None) -> Coupled:
        """Its part of the error system; continuous without ``step``. ``slope`` is what the sign term adds on N2."""
        F, K = (self.local.A, self.local.K) if step is None else (step.Phi, step.K)
        return Coupled(F, K, (chi + (slope if self.group == "N2" else 0.0)) * self.R, self.X)


def local_uio(
    C: Array, A: Array, B: Array, Bbar: Array, poles: tuple[float, ...] | None, kappa: float, who: str
) -> LocalUio:
    """The local observer of y = C x, dx/dt = A x + B u + Bbar ubar, ubar unknown to the node.

    ``poles`` are for the free part of X/W_g, as many as it needs, in order. ``kappa`` > 0 adds -kappa W_g W_g' C' to
    the injection of an N2 node: damping of its own inside W_g, which the paper's L leaves out.
    Raises DesignError when the subspaces are numerically unclear or the poles cannot be placed.
    """
    try:
        s = unknown_input_structure(C, A, Bbar, stable_abscissa())
        found = reduced_observer(C, A, s.Wg, stable_abscissa(), poles, s.L)
    except GeometryError as e:
        raise DesignError(f"{who}: {e}") from None
    hidden = intersection(s.Wg, kernel(C)).shape[1]
    n, p = A.shape[0], C.shape[0]
    matched = rank(C @ Bbar).rank == rank(Bbar).rank
    L = found.L if matched else found.L - kappa * s.Wg @ s.Wg.T @ C.T
    AL = A + L @ C
    if matched:  # W* meets Ker C only in 0, so E P + F C = I has a solution
        P = np.vstack([quotient(s.Wg), s.V.T])
        F = s.W @ np.linalg.pinv(C @ s.W)
        X = (np.eye(n) - F @ C) @ P.T
        local = Local(P @ AL @ P.T, -P @ L, P @ B, P @ s.V, np.zeros(P.shape[0]))
        R, inner = s.V.T, s.V.T @ AL @ s.V
    else:
        X, F, R, inner = np.eye(n), np.zeros((n, p)), s.Wg.T, s.Wg.T @ AL @ s.Wg
        local = Local(AL, -L, B, s.Wg, np.zeros(n))
    return LocalUio("N1" if matched else "N2", s, L, local, X, F, R, found.eigenvalues, hidden, inner)
