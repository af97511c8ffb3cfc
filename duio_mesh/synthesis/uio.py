"""E_i and P_i: take the inputs that a node is not told out of its error (seed 000, section 4.1; seed 001, H = -E)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import InputStructure
from duio_mesh.geometry.subspace import RTOL, image, norm, rank, unit_columns, unit_rows
from duio_mesh.scenario.model import Scenario

HELD = 1e-9
"""What may be left of an unknown input in a state, relative to the terms that cancel there."""

INSIDE = 1e-6
"""How far W* may be from (C, A)-invariant in a state, relative to the terms there: the end of a chain of decisions."""

ROUNDING = 1e-13
"""What rounding leaves where nothing has to cancel, relative to the whole projection and the whole column."""


class Decoupling(NamedTuple):
    """What takes the unknown inputs out of one node's error, and how far its ranks are from failing."""

    E: Array  # (n, p) of x-hat = xi - E y; E = -B̄ (C B̄)^+
    P: Array  # (n, n) = I + E C, a projection with P B̄ = 0
    basis: Array  # (n, r) orthonormal columns that span im B̄
    margins: dict[str, float]
    """Least singular values behind the rank tests, free of units: 0 fails, 1 is as good as it gets or nothing is asked.

    - ``output_rank``: of C with rows of length 1 (Assumption 1);
    - ``unknown_input_rank``: of B̄ with columns of length 1, among those kept, relative to the largest (Assumption 1);
    - ``decoupling_rank``: of C, rows of length 1, times ``basis`` (Assumption 2);
    - ``complement_rank``: of [P; basis'] (condition (10)).
    """


def decouple(C: Array, Bbar: Array, node: str = "a node", unknown: Sequence[str] = ()) -> Decoupling:
    """E and P for y = C x (p, n) and the matrix Bbar (n, .) of the inputs that the node is not told.

    Only im Bbar matters: E = -B̄ (C B̄)^+ is the same for every basis B̄ of it, so zero and dependent columns are left
    out (seed 000, Remark 1). Without an unknown input E = 0 and P = I (Remark 2). rank C is measured, not demanded.
    Raises DesignError when Assumption 2, rank(C B̄) = rank(B̄), fails; ``node`` and ``unknown`` (names) are for its text.
    Source: seed 000, (6)-(10) with H_i = 0.
    """
    p, n = C.shape
    columns = unit_columns(Bbar)
    basis = image(columns)
    r = basis.shape[1]
    rows = unit_rows(C)
    seen = np.linalg.svd(rows @ basis, compute_uv=False)
    if np.sum(seen > RTOL) < r:
        raise DesignError(_cannot_decouple(seen, p, r, node, unknown))
    E = _injection(C, rows, basis) if r else np.zeros((n, p))
    P = np.eye(n) + E @ C
    margins = {
        "output_rank": _least(rows.T, p),
        "unknown_input_rank": min(1.0, rank(columns).kept),
        "decoupling_rank": _least(rows @ basis, r),
        "complement_rank": _least(np.vstack([P, basis.T]), n),
    }
    return Decoupling(E, P, basis, margins)


def _injection(C: Array, rows: Array, basis: Array) -> Array:
    """E = -B̄ (C B̄)^+, corrected where measurements in very different units cost it its digits: E C B̄ = -B̄."""
    E: Array = -basis @ np.linalg.pinv(C @ basis)
    left = basis + E @ (C @ basis)
    if norm(left) > HELD**1.5:  # far above rounding, so an E without this trouble stays what it was
        seen = C.any(axis=1)
        lengths = np.sum(C[seen] * rows, axis=1)
        E[:, seen] -= left @ np.linalg.pinv(rows @ basis) / lengths
    return E


def decouple_node(scenario: Scenario, i: int) -> Decoupling:
    """``decouple`` for node i of the scenario. Raises DesignError that names the node and its unknown inputs."""
    found = decouple(scenario.nodes[i].C, scenario.unknown(i), f"node {i}", _unknown_names(scenario, i))
    check_decoupled(found.P, scenario, i)
    return found


def check_decoupled(P: Array, scenario: Scenario, i: int) -> None:
    """Test P b = 0 for every column b of an input that node i is not told, as the file gives it.

    ``P`` (., n) is what the design of the node multiplies the plant by. The rank decisions behind it look at columns
    and subspaces as a whole, so in bad units they may take an input for a multiple of another one. Here every state is
    compared with the terms that cancel in it, which does not depend on units.
    Raises DesignError that names the node, the input, the state and the cure.
    """
    for name, b in zip(_unknown_names(scenario, i), scenario.unknown(i).T, strict=True):
        left, terms = np.abs(P @ b), np.abs(P) @ np.abs(b)
        excess = left - HELD * terms - ROUNDING * max(norm(P), 1.0) * np.abs(b).max(initial=0.0)
        if (excess > 0).any():
            raise DesignError(_leaks(f"node {i}", name, b, left, terms, int(np.argmax(np.where(excess > 0, left, 0)))))


def check_quotient(structure: InputStructure, scenario: Scenario, i: int) -> None:
    """``check_decoupled`` for an observer on X/W*, and that what the unknown inputs reach stays inside W*.

    (I - W W') b = 0 for every unknown column and (I - W W') (A + L C) W = 0, state by state: the recursion for W*
    compares directions with ||A||_2, so in bad units it may stop before it has reached a state.
    Raises DesignError that names the node, the input or the state, and the cure.
    """
    W, C, A = structure.W, scenario.nodes[i].C, scenario.plant.A
    P = np.eye(len(A)) - W @ W.T
    check_decoupled(P, scenario, i)
    if not W.shape[1]:
        return
    closed = A + structure.L @ C
    left, terms = np.abs(P @ closed @ W), np.abs(P) @ np.abs(closed) @ np.abs(W)
    excess = left - INSIDE * terms - ROUNDING * norm(closed)
    if (excess > 0).any():
        k = int(np.argmax(excess.max(axis=1)))
        raise DesignError(
            f"node {i}: the inputs that it is not told reach state x{k + 1}, but in double precision this is lost "
            f"beside the largest entries of A ({np.abs(A).max():.2g}): its own estimate would not be free of them. "
            "Choose units of the states so that the entries of A and of every input's column have similar sizes."
        )


def _unknown_names(scenario: Scenario, i: int) -> list[str]:
    """Of the columns of scenario.unknown(i)."""
    told = set(scenario.nodes[i].knows)
    names = [name for name in scenario.plant.inputs if name not in told]
    return names + [f"disturbance {j}" for j in range(1, scenario.plant.E.shape[1] + 1)]


def _least(M: Array, wanted: int) -> float:
    """The singular value of M that must not vanish when M shall have rank ``wanted``, at most 1."""
    if wanted == 0:
        return 1.0
    return min(1.0, float(np.linalg.svd(M, compute_uv=False)[wanted - 1])) if min(M.shape) >= wanted else 0.0


def _leaks(node: str, name: str, b: Array, left: Array, terms: Array, k: int) -> str:
    sizes = np.abs(b[b != 0])
    return (
        f"{node}: it is not told {name}, but its observer cannot be decoupled from it in double precision: of terms of "
        f"size {terms[k]:.2g}, {left[k]:.2g} is left in state x{k + 1}. The input's entries, {sizes.min():.2g} to "
        f"{sizes.max():.2g} in size, hide one another beside the other inputs that it is not told. Choose units of the "
        "states so that the entries of A and of every input's column have similar sizes, or let it know this input."
    )


def _cannot_decouple(seen: NDArray[np.floating[Any]], p: int, r: int, node: str, unknown: Sequence[str]) -> str:
    names = f" ({', '.join(unknown)})" if unknown else ""
    values = ", ".join(f"{value:.3g}" for value in seen)
    return (
        f"{node}: Assumption 2 fails: rank(C_i B_iw) = {np.sum(seen > RTOL)}, but rank(B_iw) = {r}: the inputs that it "
        f"is not told{names} cannot be told apart in its measurements. Singular values, free of units: [{values}]. "
        f"{f'More unknown inputs than measurements ({p}). ' if p < r else ''}"
        "Let it know one of these inputs, or let it measure a state that they reach within one step."
    )
