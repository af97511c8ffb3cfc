"""All nodes of a reduced-order observer with their gains, and the coupling between them (seed 004).

``choose`` takes sigma and rate from the file, or finds them where the file says ``auto``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.sparse.csgraph import connected_components

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.injection import MAX_GAIN
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.geometry.subspace import norm
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.synthesis.design import Progress
from duio_mesh.synthesis.reduced_order_local import (
    Interval,
    RateError,
    Separated,
    Split,
    interval,
    local_observer,
    split,
)
from duio_mesh.synthesis.reduced_order_options import Options, bounds_of
from duio_mesh.synthesis.sampled import Coupled, Local, Step, abscissa, choose_gain, error_system, sampled

_SIGMAS = (0.5, 0.0)  # of auto: hand slow modes to the network, or only those that a node must hand over
_RATES = tuple(3.0 / 2**k for k in range(13))  # of auto: down to 7e-4 1/s, time constants of half an hour
_MODEST = 1e3  # relative gain: where auto has to give up its first rate, it does not stop at the first possible one


class Node(NamedTuple):
    """One node's own design."""

    separated: Separated
    gains: Split
    bounds: Interval
    local: Local

    def coupled(self, c: float, step: Step | None) -> Coupled:
        """Its part of the error system, continuous when ``step`` is None."""
        s = self.separated
        F, K = (self.local.A, self.local.K) if step is None else (step.Phi, step.K)
        X = np.hstack([s.V2, np.zeros((s.V2.shape[0], s.W1.shape[0]))])
        return Coupled(F, K, c * (s.V2 @ self.gains.Tu).T, X)


class Network(NamedTuple):
    """All nodes with gains for one sigma and rate, and their error system as a function of the coupling gain c."""

    sigma: float
    rate: float
    nodes: Mapping[int, Node]
    laplacian: Array
    options: Options
    bound: float | None  # (13)
    spread: float | None  # least eigenvalue of Y'(L^ kron I)Y

    def steps(self, h: float) -> dict[int, Step]:
        """Every node's own part over a tick of h seconds."""
        return {i: sampled(node.local, h, self.options) for i, node in self.nodes.items()}

    def growth(self, c: float) -> float:
        """Abscissa of the errors in continuous time."""
        return abscissa(error_system([node.coupled(c, None) for node in self.nodes.values()], self.laplacian))

    def radius(self, c: float, steps: Mapping[int, Step]) -> float:
        """Spectral radius of the errors on samples."""
        coupled = [node.coupled(c, steps[i]) for i, node in self.nodes.items()]
        return spectral_radius(error_system(coupled, self.laplacian))


class Solved(NamedTuple):
    """The network with its coupling gain."""

    network: Network
    steps: Mapping[int, Step]
    c: float

    def radius(self, h: float) -> float:
        """Spectral radius of the errors at another step."""
        return self.network.radius(self.c, self.network.steps(h))


def choose(scenario: Scenario, separated: Mapping[int, Separated], progress: Progress) -> Solved:
    """The first sigma with which gains and coupling exist, and with it the first rate.

    The two are independent: the rate concerns what a node sees, sigma and c what it does not see. A given c is judged
    with the first sigma that has gains: changing sigma behind it would hide that it is too strong for the step.
    Raises DesignError with the reason of the last attempt and the values that were tried.
    """
    options: Options = scenario.options
    sigmas = _SIGMAS if options.sigma == "auto" else (options.sigma,)
    for sigma in sigmas:
        try:
            network = _with_gains(scenario, separated, sigma, progress)
            if options.c == "auto":
                return _coupled(network, scenario, progress)
            break
        except DesignError as e:
            if sigma == sigmas[-1]:
                tried = " (observer.sigma: auto tried 0.5 and 0)" if len(sigmas) > 1 else ""
                raise DesignError(f"{e}{tried}") from None
            progress(f"observer.sigma = {sigma:g} does not hold; trying 0")
    return _coupled(network, scenario, progress)


def _with_gains(scenario: Scenario, separated: Mapping[int, Separated], sigma: float, progress: Progress) -> Network:
    """The nodes' gains with the first rate that they can hold. Raises DesignError when none is or ``_reached`` does."""
    options: Options = scenario.options
    tries = _tries(options)
    for rate, max_gain in tries:
        try:
            nodes = dict(_nodes(options, separated, sigma, rate, max_gain))
            break
        except RateError as e:
            if (rate, max_gain) == tries[-1]:
                tried = (
                    f" (observer.rate: auto tried {_RATES[0]:g} halved down to {rate:.2g})" if len(tries) > 1 else ""
                )
                raise DesignError(f"{e}{tried}") from None
    L = scenario.graph.laplacian()
    bound, spread = _reached(scenario.graph, L, nodes, sigma)
    if (sigma, rate) != (_SIGMAS[0], _RATES[0]):
        progress(f"gains for observer.sigma = {sigma:g}, observer.rate = {rate:.4g}")
    return Network(sigma, rate, nodes, L, options, bound, spread)


def _tries(options: Options) -> list[tuple[float, float]]:
    """The rates with the relative gains that are accepted: the limit itself only where nothing smaller exists."""
    if options.rate != "auto":
        return [(options.rate, MAX_GAIN)]
    slower = _RATES[1:]
    return [(_RATES[0], MAX_GAIN), *((rate, _MODEST) for rate in slower), *((rate, MAX_GAIN) for rate in slower)]


def _nodes(
    options: Options, separated: Mapping[int, Separated], sigma: float, rate: float, max_gain: float
) -> Iterator[tuple[int, Node]]:
    for i, s in separated.items():
        gains, bounds = split(s, sigma, rate, f"node {i}", max_gain), interval(s, *bounds_of(options, s.D1.shape[1]))
        yield i, Node(s, gains, bounds, local_observer(s, gains, bounds, options.kappa))


def _coupled(network: Network, scenario: Scenario, progress: Progress) -> Solved:
    """The network with the coupling gain of the file, or the one that ``auto`` finds."""
    progress("choosing the coupling")
    h = scenario.plant.step
    steps = network.steps(h)

    def rho(c: float, at: float) -> float:
        return network.radius(c, steps if at == h else network.steps(at))

    return Solved(network, steps, choose_gain("c", network.options.c, network.growth, rho, h, network.laplacian))


def _reached(graph: Graph, L: Array, nodes: Mapping[int, Node], sigma: float) -> tuple[float | None, float | None]:
    """The paper's bound (13) on c, and the least eigenvalue of Y'(L^ kron I)Y; None when no node needs help.

    The paper's Lemma 7 takes that eigenvalue to be positive under Assumption 1, which is wrong: directions that no node
    estimates alone may be common to all nodes, and then no coupling gain helps.
    """
    helped = [i for i, node in nodes.items() if node.gains.Tu.shape[1]]
    if not helped:
        return None, None
    count, labels = connected_components(L != 0, directed=True, connection="strong")
    if count > 1:
        groups = [[i for i, at in zip(graph.ids, labels, strict=True) if at == g] for g in range(count)]
        raise DesignError(
            f"the graph is not strongly connected: its strong components are {groups}, and nodes {helped} need the "
            "estimates of others to follow the whole state"
        )
    r = np.abs(linalg.null_space(L.T, rcond=1e-10)[:, 0])
    r /= r.max()
    n = next(iter(nodes.values())).separated.V2.shape[0]
    Lhat = np.diag(r) @ L + L.T @ np.diag(r)
    Y = linalg.block_diag(*(node.separated.V2 @ node.gains.Tu for node in nodes.values()))
    RA = linalg.block_diag(*(w * node.gains.Au for w, node in zip(r, nodes.values(), strict=True)))
    values, vectors = np.linalg.eigh(Y.T @ np.kron(Lhat, np.eye(n)) @ Y)
    spread = float(values[0])
    if spread <= 1e-9 * norm(Lhat):
        common = int(np.sum(values <= 1e-9 * norm(Lhat)))
        direction = (Y @ vectors[:, 0])[:n]
        raise DesignError(
            f"{common} direction(s) of the state are left to the network by every node, so no coupling can reach them: "
            f"the least eigenvalue of Y'(L^ kron I)Y is {spread:.2g} (must be positive), direction "
            f"{np.round(direction / np.linalg.norm(direction), 4).tolist()}. With observer.sigma = {sigma:g} a node "
            f"leaves its invisible modes with Re >= {-sigma + 0.0:g} to the network; "
            f"{'a smaller observer.sigma or ' if sigma else ''}one more measurement may help"
        )
    return float(np.linalg.eigvalsh(RA + RA.T)[-1]) / spread, spread
