"""The coupled observers of seed 000 as one error system (31), and what the design promises about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry import RTOL, Decomposition
from duio_mesh.geometry.stability import SCHUR, spectral_radius
from duio_mesh.geometry.subspace import norm
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.consensus import Coupling
from duio_mesh.synthesis.design import above, below
from duio_mesh.synthesis.losses import losses, without
from duio_mesh.synthesis.lyapunov import gramians
from duio_mesh.synthesis.noise import noise_covariance
from duio_mesh.synthesis.sampled import Coupled
from duio_mesh.synthesis.stacked import DENSE, Say, Stacked, largest_modulus
from duio_mesh.synthesis.uio import Decoupling


class Local(NamedTuple):
    """One node before the coupling: (6)-(15), (34)."""

    C: Array  # (p, n)
    A: Array  # (n, n), P_i A
    uio: Decoupling
    parts: Decomposition  # D_i, U_i
    K: Array  # (n, p), K_i
    beta: float  # bound (hinf) or value (others) of J_i (33)
    rho: float  # spectral radius of A_id - K_id C_id
    inert: bool  # K_i has no effect and is 0


class Network(NamedTuple):
    """All nodes, coupled."""

    nodes: Mapping[int, Local]
    g: Mapping[int, float]
    islands: Mapping[tuple[int, ...], Coupling]

    @property
    def beta(self) -> float:
        """beta_u of (38)."""
        return max(island.beta for island in self.islands.values())


def errors_of(specs: Mapping[int, NodeSpec], graph: Graph) -> Stacked:
    """e(k+1) = Phi e(k) + ... of graph.ids, (31) in the original coordinates, n |ids| rows.

    Block (i, j) is (P_i A - K_i C_i) [i = j] - g_i l_ij U_i U_i', from the N and G that the nodes are given.
    """
    I = np.eye(specs[graph.ids[0]].n)
    blocks = [Coupled(specs[i].matrices["N"], specs[i].matrices["G"], I, I) for i in graph.ids]
    return Stacked(blocks, graph.laplacian())


def predicted_rms(scenario: Scenario, network: Network, errors: Stacked, say: Say, units: Array) -> list[float | None]:
    """Stationary RMS error per state of each node under the white noise of the file; None where it takes too long, or
    where the powers of the error matrix grow beyond all digits before they decay. ``units`` (n,): of the states.

    (31) is e(k+1) = Phi e(k) + K v(k) - E v(k+1). With s = e + E v the noise enters once, s(k+1) = Phi s(k) +
    (K - Phi E) v(k), and cov e = cov s + E V E', because s(k) does not depend on v(k).
    """
    nodes = network.nodes.values()
    root = linalg.block_diag(*[_root(noise_covariance(scenario.nodes[i].noise)) for i in network.nodes])
    if not root.any():
        return [0.0 for _ in nodes]
    E = linalg.block_diag(*[own.uio.E for own in nodes]) @ root
    entry = linalg.block_diag(*[own.K for own in nodes]) @ root - errors.times(E)
    if errors.size <= DENSE:
        W = entry @ entry.T
        gramian = gramians(errors.dense(), W, np.zeros_like(W))  # as a linear system it is singular to rounding near 1
        found = None if gramian is None else np.diag(gramian[0])
    else:
        found = errors.variances(entry, say)
    if found is None:
        return [None for _ in nodes]
    variances = np.maximum(found, 0) + np.sum(E**2, axis=1)
    return [float(np.sqrt((units**2 * part).mean())) for part in np.split(variances, len(network.nodes))]


def _root(V: Array) -> Array:
    """R with R R' = V >= 0."""
    values, vectors = np.linalg.eigh(V)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def certificate(
    scenario: Scenario, network: Network, specs: Mapping[int, NodeSpec], say: Say, units: Array
) -> dict[str, Any]:
    """Plain data about the network on the scenario's graph; its states are in these ``units`` (n,) of the file's.

    Up to stacked.DENSE rows the spectral radius is that of all eigenvalues of (31). Beyond, it is an eigenvalue that
    Arnoldi's method finds, and ``spectral_radius_at_most`` is proven: by (14)-(15) the eigenvalues of (31) are those of
    the A_id - K_id C_id and of Phi_u, and a Cholesky factor has shown that ||Phi_u|| < 1. Gains without such a norm
    (``consensus: schur``) get all eigenvalues whatever it takes.
    Raises DesignError when a condition of the whole error system does not hold after all."""
    nodes, islands = network.nodes, network.islands.values()
    errors = errors_of(specs, scenario.graph)
    detectable = max(own.rho for own in nodes.values())
    contracts = network.beta < 0
    if contracts:
        undetectable = max(_radius_of(island, say) for island in islands)
        rho = errors.radius(say)
        at_most = max(detectable, float(np.sqrt(1 + network.beta)))
    else:
        say(f"all eigenvalues of {errors.size}")
        undetectable = max(spectral_radius(island.phi) for island in islands)
        rho = spectral_radius(errors.dense())
        at_most = rho
    conditions = _conditions(network, rho, scenario.options.consensus)
    if contracts and errors.size > DENSE:  # two ways to the same number must agree
        conditions["what Arnoldi's method finds is below the proven bound"] = below(rho, at_most * (1 + 1e-6))
    if scenario.options.consensus == "robust":
        conditions |= _losses(scenario.graph, specs, say)
    wrong = {name: c for name, c in conditions.items() if not c["ok"]}
    failed = [f"{name}: {c['value']:.10g}, needed {c['threshold']:.10g}" for name, c in wrong.items()]
    if failed:
        raise DesignError(f"the design does not hold what it should: {'; '.join(failed)}")
    return {
        "conditions": conditions,
        "nodes": _nodes(network, predicted_rms(scenario, network, errors, say, units)),
        "spectral_radius": rho,
        "spectral_radius_at_most": at_most,
        "spectral_radius_detectable": detectable,
        "spectral_radius_undetectable": undetectable,
        "decomposition": scenario.options.decomposition,
        "consensus": scenario.options.consensus,
        "g": list(network.g.values()),
        "beta_u": network.beta,
        "beta_u_lower_bound": max(island.lower for island in islands),
        "norm_phi_u": max(island.norm for island in islands),
        "rate_bound": None if network.beta >= 0 else float(np.sqrt(max(0.0, 1 + network.beta))),
        "beta_id": [own.beta for own in nodes.values()],
    }


def _radius_of(island: Coupling, say: Say) -> float:
    """Spectral radius of Phi_u."""
    return largest_modulus(
        island.pencil.N,
        lambda X: island.pencil.drive(island.g, X),
        lambda: island.phi,
        lambda what: say(f"Phi_u: {what}"),
    )


def _conditions(network: Network, rho: float, consensus: str) -> dict[str, dict[str, Any]]:
    """What has to hold; rank margins are singular values free of units, of the worst node."""
    nodes = network.nodes
    margins = {
        "Assumption 1, rank C_i": "output_rank",
        "Assumption 1, rank B_iw": "unknown_input_rank",
        "Assumption 2, rank C_i B_iw": "decoupling_rank",
        "(10), rank [P_i; B_iw^+]": "complement_rank",
    }
    found = {}
    for name, key in margins.items():
        worst = min(nodes, key=lambda i: nodes[i].uio.margins[key])
        value = nodes[worst].uio.margins[key]
        found[f"{name} (node {worst})"] = above(value, RTOL)
    leak = {i: _leak(own) for i, own in nodes.items()}
    worst = max(leak, key=lambda i: leak[i])
    found[f"(14)-(15), U_i invariant and unseen (node {worst})"] = below(leak[worst], 1e-7)
    worst = max(nodes, key=lambda i: nodes[i].rho)
    found[f"A_id - K_id C_id is Schur (node {worst})"] = below(nodes[worst].rho, SCHUR)
    if consensus != "schur":
        found["(39)-(40), beta_u"] = below(network.beta, 0.0)
    found["the error matrix of (31) is Schur"] = below(rho, SCHUR)
    return found


def _losses(graph: Graph, specs: Mapping[int, NodeSpec], say: Say) -> dict[str, dict[str, Any]]:
    """The largest eigenvalue of all graphs with one link lost, by the eigenvalues themselves."""
    radii = {}
    for loss in losses(graph, 1):
        if loss.links:
            name = loss.words(graph)
            say(f"eigenvalues with {name} lost")
            radii[name] = errors_of(specs, without(graph, loss)).radius()
    if not radii:
        return {}
    worst = max(radii, key=lambda lost: radii[lost])
    return {f"(31) is Schur with any one link lost ({worst})": below(radii[worst], SCHUR)}


def _leak(own: Local) -> float:
    """How far U_i is from being P_i A-invariant and inside ker C_i, relative to the matrices."""
    D, U = own.parts.D, own.parts.U
    return max(norm(own.C @ U) / (norm(own.C) or 1.0), norm(D.T @ own.A @ U) / (norm(own.A) or 1.0))


def _nodes(network: Network, rms: list[float | None]) -> dict[int, dict[str, Any]]:
    return {
        i: {
            "unknown_inputs": own.uio.basis.shape[1],
            "nu": own.parts.nu,
            "decoupling_margin": own.uio.margins["decoupling_rank"],
            "output_margin": own.uio.margins["output_rank"],
            "norm_E": norm(own.uio.E),
            "norm_K": norm(own.K),
            "K_is_inert": own.inert,
            "beta_id": own.beta,
            "local_spectral_radius": own.rho,
            "g": network.g[i],
            "predicted_rms": predicted,
        }
        for (i, own), predicted in zip(network.nodes.items(), rms, strict=True)
    }
