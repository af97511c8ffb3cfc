"""The local half of seed 002: what each node can follow alone, and whether the nodes of an island see everything."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import (
    GeometryError,
    InputStructure,
    ReducedObserver,
    Stability,
    rank,
    reduced_observer,
    stable_radius,
    unknown_input_structure,
)
from duio_mesh.scenario.model import Normal, Scenario
from duio_mesh.synthesis.admm_options import Options
from duio_mesh.synthesis.lyapunov import gramians
from duio_mesh.synthesis.uio import check_quotient

LEAST_CURVATURE = 1e-10
"""Assumption 2 fails below this ratio of H's extreme eigenvalues: H^-1 would have no correct digit left to spare."""


class Local(NamedTuple):
    """One node's own estimate (5) and its share T_i of the state."""

    structure: InputStructure
    filter: ReducedObserver
    T: Array  # (n - w + p, n) = [P; C]
    PB: Array  # (n - w, m_i)
    s0: Array  # (n - w,)

    @property
    def radius(self) -> float:
        """How fast its error decays per step; 0 when it follows nothing."""
        return float(np.abs(self.filter.eigenvalues).max(initial=0.0))


def local_estimates(scenario: Scenario, options: Options) -> dict[int, Local]:
    """P_i, L_i, Abar_i of (5) for every node. Raises DesignError that names the node when one has no stable filter."""
    A, stability = scenario.plant.A, stable_radius(options.stable_radius)
    found = {}
    for i, node in scenario.nodes.items():
        try:
            structure = unknown_input_structure(node.C, A, scenario.unknown(i), stability)
            filter_ = reduced_observer(node.C, A, structure.Wg, stability, options.poles, structure.L)
        except GeometryError as e:
            raise DesignError(f"node {i}: no local estimate (5): {e}") from None
        check_quotient(structure, scenario, i)
        P = filter_.P
        x0 = scenario.plant.x0
        start = x0.mean if isinstance(x0, Normal) else x0
        s0 = P @ start if options.initial == "projection" else np.zeros(len(P))
        found[i] = Local(structure, filter_, np.vstack([P, node.C]), P @ scenario.known(i), s0)
    return found


def check_joint(island: Iterable[int], nodes: Mapping[int, Local], stability: Stability) -> Array:
    """H's eigenvalues, ascending, for the nodes of one island.

    Raises DesignError with the directions that no node of the island follows or measures (Assumption 2, (6)).
    """
    ids = list(island)
    T = np.vstack([nodes[i].T for i in ids])
    _, sigma, Vh = np.linalg.svd(T) if T.shape[0] else (None, np.zeros(0), np.eye(T.shape[1]))
    eigenvalues = np.sort(np.concatenate([sigma**2, np.zeros(T.shape[1] - min(T.shape))]))
    largest = float(eigenvalues[-1])
    if eigenvalues[0] > LEAST_CURVATURE * largest:
        return np.asarray(eigenvalues)
    missing = int(np.count_nonzero(eigenvalues <= LEAST_CURVATURE * largest))
    lost = "; ".join(direction(v) for v in Vh[::-1][:missing])
    left_out = [f"node {i}: {numbers(nodes[i].structure.bad)}" for i in ids if nodes[i].structure.bad.size]
    because = (
        f" Zeros outside {stability} are not followed ({'; '.join(left_out)}); observer.stable_radius moves that bound."
        if left_out
        else ""
    )
    raise DesignError(
        f"Assumption 2 fails on {'the island of ' if len(nodes) > len(ids) else ''}nodes {ids}: together they neither "
        f"follow nor measure {missing} direction(s) of the state: {lost}. Eigenvalues of H = sum T_i'T_i: "
        f"{np.array2string(eigenvalues, precision=4)}.{because} Another measurement, a further known input or an edge "
        "to nodes that see these directions would help."
    )


def direction(v: Array) -> str:
    """A unit vector in words: its components above 1 % of the largest."""
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return " ".join(f"{value:+.2f} x{k + 1}" for k, value in enumerate(v) if abs(value) > 0.01 * np.abs(v).max())


def numbers(values: NDArray[np.complex128]) -> str:
    """Eigenvalues in words, one per conjugate pair."""
    return ", ".join(f"{v.real:.5g}" if not v.imag else f"{v.real:.5g} +- {v.imag:.5g}i" for v in values if v.imag >= 0)


def facts(local: Local) -> dict[str, Any]:
    """What the certificate says about one node."""
    s = local.structure
    return {
        "dimension_W": s.W.shape[1],
        "dimension_S": s.S.shape[1],
        "dimension_Wg": s.Wg.shape[1],
        "zeros": _plain(s.zeros),
        "bad_zeros": _plain(s.bad),
        "local_eigenvalues": _plain(local.filter.eigenvalues),
        "local_radius": local.radius,
        "gain_norm": float(np.linalg.norm(local.filter.L, 2)) if local.filter.L.size else 0.0,
        "reconstructs_alone": rank(local.T).rank,
        "least_kept_singular_value": s.margin.kept if np.isfinite(s.margin.kept) else None,
    }


def _plain(values: NDArray[np.complex128]) -> list[list[float]]:
    return [[float(v.real), float(v.imag)] for v in values]


def noise_gain(nodes: Iterable[Local], maps: Array) -> Array:
    """(n,) the worst node's standard deviation of x-hat - x per unit of white noise on every measurement.

    ``maps`` (., n, r) take the stacked xi = [s_1; y_1; s_2; ...] to estimates; see ``fused_maps``. The local error
    obeys e+ = Abar e - P L v, so xi - T x has the covariance of e beside that of v.
    """
    blocks = []
    for local in nodes:
        f = local.filter
        drive = f.P @ f.L
        blocks += [_stationary(f.Abar, drive @ drive.T), np.eye(f.L.shape[1])]
    covariance = linalg.block_diag(*blocks)
    variances: Array = np.einsum("kab,bc,kac->ka", maps, covariance, maps)
    return np.asarray(np.sqrt(np.maximum(variances.max(axis=0), 0)))  # rounding may leave -1e-20 where nothing enters


def _stationary(Phi: Array, W: Array) -> Array:
    """X = Phi X Phi' + W for Schur Phi, by doubling: the linear system for X is singular to rounding near 1."""
    if not len(Phi):
        return Phi
    found = gramians(Phi, W, np.zeros_like(W))
    if found is not None:
        return found[0]
    with warnings.catch_warnings():  # powers of Phi beyond 1e15: no way is accurate, and this one gives the size
        warnings.simplefilter("ignore", linalg.LinAlgWarning)
        return np.asarray(linalg.solve_discrete_lyapunov(Phi, W))
