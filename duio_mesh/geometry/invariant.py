"""(C,A)-invariant subspaces: what a sensor can know about the state while an unknown input acts (seeds 002 and 003).

For y = C x, x+ (or dx/dt) = A x + B u with u unknown to the node:

- W* is the smallest subspace that contains Im B and that some output injection L makes (A + L C)-invariant. Nothing
  inside W* can be followed without knowing u; on X/W* the unknown input is gone.
- S* is the smallest unobservability subspace that contains W*. The spectrum of A + L C on S*/W* is the same for every
  friend L of W*: the invariant zeros of (A, B, C). On X/S* the spectrum is free.
- W*_g = W* and the directions of S*/W* that belong to bad zeros (seed 002, (4); seed 003, (8)): the smallest such
  subspace with X/W*_g observable by a stable filter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.geometry.stability import Stability, split_spectrum
from duio_mesh.geometry.staircase import unobservable_with_margin
from duio_mesh.geometry.subspace import (
    RTOL,
    GeometryError,
    Rank,
    add_with_margin,
    as_matrix,
    as_pair,
    excess,
    gap,
    image,
    kernel,
    kernel_with_margin,
    norm,
    quotient,
    residual,
    unit_columns,
    unit_rows,
)

# an invariance that holds exactly may miss by this many rtol: it is the end of a chain of decisions of rtol each
_CHAIN = 1000.0


@dataclass(frozen=True)
class InputStructure:
    """The subspaces of (A, B, C) with unknown input through B, all as orthonormal bases of R^n."""

    W: Array  # (n, w) W*, infimal (C,A)-invariant subspace containing Im B
    S: Array  # (n, s) S*, infimal unobservability subspace containing Im B; contains W*
    V: Array  # (n, b) bad zero directions, orthogonal to W*
    Wg: Array  # (n, w + b) W*_g = [W V]
    L: Array  # (n, p) the friend of smallest norm of W*, hence of W*_g and S* too
    zeros: NDArray[np.complex128]  # (s - w,) invariant zeros, the bad ones first
    bad: NDArray[np.complex128]  # (b,) those outside the stability region
    margin: Rank  # the least clear decisions about W* and S*, relative to 1 or ||A||_2 (rank: no meaning here)


def infimal_invariant(C: Array, A: Array, B: Array, rtol: float = RTOL) -> Array:
    """W*(C, A; Im B) by W <- W + A (W and Ker C). C (p, n), A (n, n), B (n, m).

    ``rtol`` is relative to 1 for B's columns and C's rows (scaled to length 1) and to ||A||_2 for A.
    """
    return _infimal_invariant(C, A, B, rtol)[0]


def _infimal_invariant(C: Array, A: Array, B: Array, rtol: float) -> tuple[Array, Rank]:
    C, size = unit_rows(C), norm(A)
    W, margin = add_with_margin(np.zeros((A.shape[0], 0)), unit_columns(B), rtol)
    while True:  # grows at every turn, so at most n turns
        hidden, decided = kernel_with_margin(C @ W, rtol, scale=1.0)
        grown, added = add_with_margin(W, A @ (W @ hidden), rtol, scale=size)
        margin = margin.worst(decided).worst(added)
        if grown.shape[1] == W.shape[1]:
            return W, margin._replace(rank=W.shape[1])
        W = grown


def infimal_unobservability(C: Array, A: Array, W: Array, rtol: float = RTOL) -> Array:
    """S*: the infimal unobservability subspace containing W = W*, by S <- W + (A^-1 S and Ker C), from S = X.

    With W = 0 it is the unobservable subspace, found by the staircase for it.
    Raises GeometryError when the recursion has not settled after 2 n + 4 steps; in exact arithmetic it needs at most n.
    """
    return _infimal_unobservability(C, A, W, rtol)[0]


def _infimal_unobservability(C: Array, A: Array, W: Array, rtol: float) -> tuple[Array, Rank]:
    if not W.shape[1]:
        return unobservable_with_margin(unit_rows(C), A, rtol)
    n, size = A.shape[0], norm(A)
    K, margin = kernel_with_margin(unit_rows(C), rtol, scale=1.0)
    S: Array = np.eye(n)
    for _ in range(2 * n + 4):  # rounding may hold a dimension up for some turns
        back, decided = kernel_with_margin(residual(S, A @ K), rtol, scale=size)
        smaller, added = add_with_margin(W, K @ back, rtol)
        margin = margin.worst(decided).worst(added)
        if gap(smaller, S) <= np.sqrt(rtol):
            return smaller, margin
        S = smaller
    raise GeometryError(
        f"the unobservability subspace did not settle within {2 * n + 4} steps: whether some direction is seen "
        f"is undecided between {rtol:g} and rounding. Measure more of the state, let more inputs be known, or give A "
        "and the inputs with more digits"
    )


def friend(C: Array, A: Array, W: Array, rtol: float = RTOL) -> Array:
    """L (n, p) of smallest norm with (A + L C) W inside W.

    Raises GeometryError when W is not (C,A)-invariant: A (W and Ker C) sticks out of W by more than the tolerance.
    """
    P, size = quotient(W), norm(A)
    hidden = kernel(unit_rows(C) @ W, rtol, scale=1.0)
    stuck = norm(P @ A @ W @ hidden)
    if stuck > _CHAIN * rtol * size:
        raise GeometryError(
            f"a subspace of dimension {W.shape[1]} is not (C,A)-invariant: A maps its part in Ker C out of it by "
            f"{stuck / size if size else stuck:.1e} relative to |A|, at rtol = {rtol:g}"
        )
    seen = W @ quotient(hidden).T  # C is injective here
    if not seen.shape[1]:
        return np.zeros((A.shape[0], C.shape[0]))
    return -P.T @ (P @ A @ seen) @ np.linalg.pinv(C @ seen, rcond=1e-15)


def unknown_input_structure(C: Array, A: Array, B: Array, stability: Stability, rtol: float = RTOL) -> InputStructure:
    """W*, S*, W*_g, a common friend and the invariant zeros of y = C x, x+ = A x + B u, u unknown.

    C (p, n), A (n, n), B (n, m), m and p may be 0; zeros outside ``stability`` are bad. ``rtol`` as in
    ``infimal_invariant``. Raises GeometryError for wrong shapes, NaN, or when the subspaces do not settle at ``rtol``.
    """
    C, A = as_pair(C, A)
    B = as_matrix("B", B, rows=A.shape[0])
    W, decided = _infimal_invariant(C, A, B, rtol)
    S, also = _infimal_unobservability(C, A, W, rtol)
    L = friend(C, A, W, rtol)
    Q = image(residual(W, S), rtol, scale=1.0)  # orthonormal, represents S*/W*
    if excess(W, S) > np.sqrt(rtol) or Q.shape[1] != S.shape[1] - W.shape[1]:
        raise GeometryError(
            f"the unobservability subspace lost a part of W*: whether a direction that the unknown inputs reach is "
            f"seen is undecided at {rtol:g}. Measure more of the state, or choose units in which the matrices' entries "
            "have similar sizes"
        )
    Z, bad, good = split_spectrum(Q.T @ (A + L @ C) @ Q, stability)
    V = Q @ Z
    return InputStructure(W, S, V, np.hstack([W, V]), L, np.concatenate([bad, good]), bad, decided.worst(also))
