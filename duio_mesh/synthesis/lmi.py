"""Node-wise decomposition DUIO (seed 000): unknown-input decoupling, local output injection, diffusive coupling.

Every gain is designed here from the whole scenario; what a node gets is its own N, M, L, E, G of (16)-(17).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import (
    RTOL,
    GeometryError,
    detectability_decomposition,
    observability_decomposition,
    stable_radius,
)
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.scenario.strict import Strict
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.absence import Absence
from duio_mesh.synthesis.design import Design, Progress, node_spec, plant_spec
from duio_mesh.synthesis.lmi_coupling import couple_islands
from duio_mesh.synthesis.lmi_network import Local, Network, certificate, errors_of
from duio_mesh.synthesis.local_gain import Subsystem, h2_gain, hinf_gain, placed_gain, worst_gain
from duio_mesh.synthesis.noise import noise_covariance
from duio_mesh.synthesis.uio import decouple_node
from duio_mesh.synthesis.units import from_state, in_some_units, in_units, said, to_state

__all__ = ["RADIUS_OF", "Options", "design", "error_radius"]

RADIUS_OF = "error matrix (31), per step"

Pole = Annotated[float, Field(gt=-1, lt=1)]


class Poles(Strict):
    """Real poles spread evenly from the first to the second number."""

    poles: tuple[Pole, Pole]

    @model_validator(mode="after")
    def _ordered(self) -> Poles:
        if self.poles[0] >= self.poles[1]:
            raise ValueError("the first pole should be less than the second")
        return self


class Options(Absence):
    """The keys under ``observer:`` for ``method: lmi``."""

    decomposition: Literal["detectability", "observability"] = "detectability"
    """What the neighbours must supply: unobservable modes that are not stable, or all unobservable modes."""
    local_gain: Literal["hinf", "h2"] | Poles = "hinf"
    """K_id: (34), or the least stationary error variance under the file's noise, or given poles."""
    consensus: Literal["paper", "norm", "robust", "schur"] = "norm"
    """g: (38)-(39) as printed; the least ||Phi_u||_2, which is (49); the least that holds with any one edge lost too;
    or any that stabilise, by the spectral radius itself."""


def design(scenario: Scenario, progress: Progress) -> Design:
    """Check Assumptions 1 and 2, decompose every node, design K_i and g_i, certify the whole error system (31).

    Raises DesignError when the plant is not discrete, a rank condition fails, a local gain cannot be computed or the
    consensus problem (38)-(40) has no solution; the message names the nodes and the numbers.
    """
    if scenario.plant.time != "discrete":
        raise DesignError("lmi needs a discrete plant (time: discrete); its observers are difference equations")
    return in_some_units(scenario, lambda s: _design(scenario, s, progress), progress)


def _design(scenario: Scenario, s: Array, progress: Progress) -> Design:
    """The design in the units s (n,) of the states."""
    even, nodes = in_units(scenario, s), {}
    for i in even.nodes:
        progress(f"decoupling, decomposition and local gain of node {i}")
        nodes[i] = _local(even, i)
    network = couple_islands(even, nodes, progress)
    progress("certificate")
    specs = {i: _spec(even, i, network) for i in nodes}
    promises = certificate(even, network, specs, lambda what: progress(f"certificate: {what}"), s)
    return Design(scenario, plant_spec(scenario), {i: _back(spec, s) for i, spec in specs.items()}, promises | said(s))


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of (31) of graph.ids with the designed gains on another graph."""
    return errors_of(design.nodes, graph).radius()


def _local(scenario: Scenario, i: int) -> Local:
    """Decoupling, decomposition and K_i = D_i K_id of node i."""
    options: Options = scenario.options
    C, name, uio = scenario.nodes[i].C, f"node {i}", decouple_node(scenario, i)
    p = len(C)
    if uio.margins["output_rank"] <= RTOL:
        raise DesignError(
            f"{name}: Assumption 1 fails: its {p} measurements are not independent, rank(C_i) < {p} (least singular "
            f"value {uio.margins['output_rank']:.2g} with rows of length 1). Replace dependent rows by their mean."
        )
    A = uio.P @ scenario.plant.A
    try:
        if options.decomposition == "detectability":
            parts = detectability_decomposition(C, A, stable_radius())
        else:
            parts = observability_decomposition(C, A)
    except GeometryError as e:
        raise DesignError(f"{name}: no {options.decomposition} decomposition of (P_i A, C_i): {e}") from None
    D = parts.D
    system = Subsystem(D.T @ A @ D, C @ D, D.T @ uio.E)  # (14), (15)
    # As many unknown inputs as measurements: I + C_i E_i = 0, so C_i P_i = 0, and the innovation
    # (I + C_i E_i) y - C_i xi is zero for ever, because xi(0) = 0. K_i then multiplies nothing, and is 0.
    inert = uio.basis.shape[1] == p
    Kd, beta = np.zeros((D.shape[1], p)), None
    if not inert and options.local_gain == "hinf":
        Kd, beta = hinf_gain(system, name)
    elif not inert and options.local_gain == "h2":
        # measurements that unknown inputs enter carry no innovation: the filter sees the complement of im C_i B_iw
        seen = np.linalg.qr(C @ uio.basis, mode="complete")[0][:, uio.basis.shape[1] :]
        Kd = h2_gain(system, seen, noise_covariance(scenario.nodes[i].noise), name)
    elif not inert and isinstance(options.local_gain, Poles):
        Kd = placed_gain(system, *options.local_gain.poles, name)
    if beta is None:
        beta = worst_gain(system, Kd)
    # (19) prints K_i = D_i' K_id; the dimensions and (20) need D_i
    return Local(C, A, uio, parts, D @ Kd, beta, spectral_radius(system.A - Kd @ system.C), inert)


def _spec(scenario: Scenario, i: int, network: Network) -> NodeSpec:
    """The matrices of (16)-(17): N = P A - K C, L of (18), M = P B_i, E, G of (19)."""
    own = network.nodes[i]
    E, P, K, U = own.uio.E, own.uio.P, own.K, own.parts.U
    matrices = {
        "N": own.A - K @ own.C,
        "L": K @ (np.eye(len(own.C)) + own.C @ E) - own.A @ E,
        "M": P @ scenario.known(i),
        "E": E,
        "G": network.g[i] * U @ U.T,
    }
    return node_spec(scenario, i, matrices)


def _back(spec: NodeSpec, s: Array) -> NodeSpec:
    """The spec of a node that was designed in the units s, in the file's."""
    M = {name: to_state(matrix, s) for name, matrix in spec.matrices.items()}
    return replace(spec, matrices=M | {name: from_state(M[name], s) for name in ("N", "G")})
