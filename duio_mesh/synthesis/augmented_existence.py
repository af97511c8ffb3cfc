"""When an augmented-state observer exists (seed 001, Lemma 4 and Theorem 8 (iv)).

Condition (iv) asks that no v != 0 and |lambda| >= 1 satisfy P_i A v = lambda v, C_i v = 0 at every node i. v ranges
over C^n, because lambda may be complex. Nothing here looks at computed eigenvalues of a defective matrix: each test is
a staircase, and the three of them are equivalent on paper but differ in arithmetic.

The paper proves sufficiency for connected undirected graphs. In general Phi is block triangular over the strongly
connected components; only a component that hears nobody outside has a singular Laplacian block, so (iv) is needed, and
enough, for each such source component with its own sensors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import (
    Decomposition,
    Stability,
    detectability_decomposition,
    image,
    intersection,
    quotient,
    unobservable_subspace,
)
from duio_mesh.geometry.subspace import unit_rows
from duio_mesh.scenario.model import Graph
from duio_mesh.synthesis.uio import decouple


class Component(NamedTuple):
    """A strongly connected component of the graph."""

    ids: tuple[int, ...]  # ascending
    source: bool  # it hears nobody outside


class View(NamedTuple):
    """What condition (iv) reads of one node."""

    C: Array  # (p, n)
    P: Array  # (n, n)
    D: Array  # (n, r), orthonormal, spans the inputs that the node is not told


def components(graph: Graph) -> list[Component]:
    """The strongly connected components in the order of their smallest id."""
    ids = graph.ids
    at = {i: k for k, i in enumerate(ids)}
    hears = np.zeros((len(ids), len(ids)))
    for arc in graph.arcs:
        hears[at[arc.target], at[arc.source]] = 1.0
    _, label = connected_components(hears, directed=True, connection="strong")
    groups = {int(c): tuple(i for i in ids if label[at[i]] == c) for c in label}
    return [
        Component(group, all(a.source in group for a in graph.arcs if a.target in group))
        for group in sorted(groups.values())
    ]


def unseen_jointly(views: Sequence[View], A: Array, stability: Stability) -> Decomposition:
    """Test a: the undetectable part of (G, P_1 A) with G = [C_1; ...; C_N; (P_i - P_1) A, i >= 2].

    A v solves (20) at every node exactly when P_1 A v = lambda v and G v = 0. Solvable when the result has nu = 0.
    """
    return detectability_decomposition(_agreement(views, A), views[0].P @ A, stability)


def unseen_centrally(views: Sequence[View], A: Array, stability: Stability) -> Decomposition:
    """Test b: the undetectable part of (C, P_0 A) for one centralised observer with all outputs C, decoupled only from
    the inputs that are unknown to every node: im D_0 = the intersection of all im D_i. Equivalent to test a by (29)."""
    C = np.vstack([view.C for view in views])
    D0 = views[0].D
    for view in views[1:]:
        D0 = intersection(D0, view.D)
    return detectability_decomposition(C, decouple(C, D0, "all nodes together").P @ A, stability)


def unseen_by_subspaces(views: Sequence[View], A: Array, stability: Stability) -> Array:
    """Test c: the largest P_1 A-invariant subspace of the common undetectable subspace on which all P_i A agree.

    Solvable when it is {0}. That the common undetectable subspace itself is {0} (the condition of the paper's [2] and
    [22]) is sufficient, not necessary. Returns an orthonormal basis (n, k).
    """
    common = detectability_decomposition(views[0].C, views[0].P @ A, stability).U
    for view in views[1:]:
        common = intersection(common, detectability_decomposition(view.C, view.P @ A, stability).U)
    rows = np.vstack([quotient(common), _agreement(views, A)])
    return unobservable_subspace(image(rows.T, scale=1.0).T, views[0].P @ A)


def _agreement(views: Sequence[View], A: Array) -> Array:
    """Orthonormal rows with the kernel of G; C has unit rows and A norm 1 before, so that units do not matter."""
    size = float(np.linalg.norm(A, 2)) or 1.0
    rows = [unit_rows(view.C) for view in views]
    rows += [(view.P - views[0].P) @ A / size for view in views[1:]]
    return image(np.vstack(rows).T, scale=1.0).T


def check(graph: Graph, views: Mapping[int, View], A: Array, stability: Stability) -> list[dict[str, Any]]:
    """Condition (iv) on every source component, by all three tests.

    Returns, per source component, its nodes and how clearly the staircase of test a decided (singular values relative
    to 1 that counted as nonzero and as zero). Raises DesignError that names the component, the eigenvalue and the
    direction that none of its sensors can see.
    """
    return [
        _check_source(component.ids, [views[i] for i in component.ids], A, stability, len(graph.ids))
        for component in components(graph)
        if component.source
    ]


def _check_source(
    ids: tuple[int, ...], views: Sequence[View], A: Array, stability: Stability, nodes: int
) -> dict[str, Any]:
    joint = unseen_jointly(views, A, stability)
    unseen = (joint.nu, unseen_centrally(views, A, stability).nu, unseen_by_subspaces(views, A, stability).shape[1])
    who = f"nodes {', '.join(map(str, ids))}" if len(ids) > 1 else f"node {ids[0]}"
    isolated = f", and {'they hear' if len(ids) > 1 else 'it hears'} nobody else" if len(ids) < nodes else ""
    if joint.nu:
        value, v = _mode(joint.U, views[0].P @ A)
        raise DesignError(
            f"{who}: Theorem 8 (iv) fails: the mode with eigenvalue {_number(value)} along v = ({_numbers(v)}) is "
            f"seen by {'none of them' if len(ids) > 1 else 'none of its outputs'} (P_i A v = lambda v, C_i v = 0)"
            f"{isolated}. No gains can make its error decay (needed: {stability}). Measure v somewhere, let a node "
            f"know one more input{', or let them hear a node that sees it' if isolated else ''}."
        )
    if any(unseen):
        raise DesignError(
            f"{who}: Theorem 8 (iv) cannot be decided in double precision: its three equivalent tests find {unseen} "
            "unseen modes. The data lie within rounding of a system without an observer."
        )
    return {"nodes": list(ids), "kept": joint.rank.kept, "dropped": joint.rank.dropped}


def _mode(U: Array, A: Array) -> tuple[complex, NDArray[np.complex128]]:
    """The largest eigenvalue of A on the invariant subspace U, and its eigenvector, largest entry 1."""
    values, vectors = np.linalg.eig(U.T @ A @ U)
    k = int(np.argmax(np.abs(values)))
    v = U @ vectors[:, k]
    return complex(values[k]), np.asarray(v / v[np.argmax(np.abs(v))], dtype=np.complex128)


def _number(z: complex) -> str:
    return f"{z.real:.6g}" if abs(z.imag) <= 1e-9 * abs(z) else f"{z.real:.6g}{z.imag:+.6g}i"


def _numbers(v: NDArray[np.complex128]) -> str:
    return ", ".join(_number(0.0 if abs(z) < 1e-9 else complex(z)) for z in v)
