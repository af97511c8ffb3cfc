"""Reduced-order distributed unknown-input observer with unknown-input and noise reconstruction (seed 004).

Continuous time, directed strongly connected graphs. Every node knows the same inputs; the others, and the plant's
disturbances, are the unknown input f that every node reconstructs beside the state and its own measurement noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat
from scipy import linalg
from scipy.sparse.csgraph import connected_components

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.injection import MAX_GAIN
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.geometry.staircase import detectability_decomposition
from duio_mesh.geometry.subspace import GeometryError, norm
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.design import Design, Progress, node_spec, plant_spec
from duio_mesh.synthesis.reduced_order_local import (
    WORST_CONDITION,
    Interval,
    Model,
    RateError,
    Separated,
    Split,
    hidden_from,
    interval,
    local_observer,
    separate,
    split,
)
from duio_mesh.synthesis.sampled import (
    Coupled,
    HoldOptions,
    Local,
    Step,
    abscissa,
    choose_gain,
    error_system,
    largest_step,
    modes,
    sampled,
)

RADIUS_OF = "sampled error system, per tick"

_SIGMAS = (0.5, 0.0)  # of auto: hand slow modes to the network, or only those that a node must hand over
_RATES = tuple(3.0 / 2**k for k in range(13))  # of auto: down to 7e-4 1/s, time constants of half an hour
_MODEST = 1e3  # relative gain: where auto has to give up its first rate, it does not stop at the first possible one


class Options(HoldOptions):
    """The keys under ``observer:`` for ``method: reduced_order``."""

    c: PositiveFloat | Literal["auto"] = "auto"
    """Coupling gain, 1/s. ``auto``: the smallest one whose sampled error decays about as fast as any."""
    sigma: NonNegativeFloat | Literal["auto"] = "auto"
    """1/s. Invisible modes with Re >= -sigma are left to the network (0: the paper). ``auto``: 0.5, or 0 if need be."""
    rate: PositiveFloat | Literal["auto"] = "auto"
    """1/s. Visible modes are moved left of -rate. ``auto``: 3, halved until reliable gains exist."""
    kappa: PositiveFloat = 5.0
    """1/s. M = -kappa I of the interval observer; larger amplifies state errors in the unknown input."""
    bounds: tuple[tuple[float, float], ...] | None = None
    """[low, high] of each unknown input, default [-5, 5]. Only a scale: leaving them costs no accuracy."""
    lipschitz: PositiveFloat = 50.0
    """1/s^2. Bound on the second derivative of alpha. A step of f takes up to about kappa/lipschitz s."""


class _Node(NamedTuple):
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


class _Network(NamedTuple):
    """All nodes with gains for one sigma and rate, and their error system as a function of the coupling gain c."""

    sigma: float
    rate: float
    nodes: Mapping[int, _Node]
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


class _Coupled(NamedTuple):
    """The network with its coupling gain."""

    network: _Network
    steps: Mapping[int, Step]
    c: float

    def radius(self, h: float) -> float:
        """Spectral radius of the errors at another step."""
        return self.network.radius(self.c, self.network.steps(h))


def design(scenario: Scenario, progress: Progress) -> Design:
    """Gains, conditions and node specs.

    Raises DesignError, with numbers and node names, when the plant is not continuous, nodes know different inputs,
    Assumption 1 or 2 fails, observer.rate asks for unreliable gains, the graph does not connect the nodes that need
    help, the coupling cannot reach a direction that no node sees (sufficient condition), or the coupling is unstable at
    this step.
    """
    D, unknown = _unknown_input(scenario)
    _bounds(scenario.options, D.shape[1])
    plant, separated = scenario.plant, {}
    for i, node in scenario.nodes.items():
        progress(f"node {i}: removing noise and unknown input")
        model = Model(plant.A, scenario.known(i), D, node.C, node.noise.channel)
        separated[i] = separate(model, f"node {i}", unknown)
    _jointly_detectable(scenario, D, separated, unknown)
    chosen = _choose(scenario, separated, progress)
    network, steps, c = chosen
    certificate = {
        "conditions": _conditions(network.nodes, network.spread),
        "nodes": {i: _facts(node) for i, node in network.nodes.items()},
        "spectral_abscissa": network.growth(c),
        "sampled_radius": network.radius(c, steps),
        "c": c,
        "sigma": network.sigma,
        "rate": network.rate,
        "c_bound_13": network.bound,
        "step": plant.step,
        "largest_step": largest_step(chosen.radius, plant.step),
    }
    specs = {i: _spec(scenario, i, node, steps[i], c) for i, node in network.nodes.items()}
    return Design(scenario, plant_spec(scenario), specs, certificate)


def _choose(scenario: Scenario, separated: Mapping[int, Separated], progress: Progress) -> _Coupled:
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


def _with_gains(scenario: Scenario, separated: Mapping[int, Separated], sigma: float, progress: Progress) -> _Network:
    """The nodes' gains with the first rate that they can hold. Raises DesignError when none is or ``_network`` does."""
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
    bound, spread = _network(scenario.graph, L, nodes, sigma)
    if (sigma, rate) != (_SIGMAS[0], _RATES[0]):
        progress(f"gains for observer.sigma = {sigma:g}, observer.rate = {rate:.4g}")
    return _Network(sigma, rate, nodes, L, options, bound, spread)


def _tries(options: Options) -> list[tuple[float, float]]:
    """The rates with the relative gains that are accepted: the limit itself only where nothing smaller exists."""
    if options.rate != "auto":
        return [(options.rate, MAX_GAIN)]
    slower = _RATES[1:]
    return [(_RATES[0], MAX_GAIN), *((rate, _MODEST) for rate in slower), *((rate, MAX_GAIN) for rate in slower)]


def _nodes(
    options: Options, separated: Mapping[int, Separated], sigma: float, rate: float, max_gain: float
) -> Iterator[tuple[int, _Node]]:
    for i, s in separated.items():
        gains, bounds = split(s, sigma, rate, f"node {i}", max_gain), interval(s, *_bounds(options, s.D1.shape[1]))
        yield i, _Node(s, gains, bounds, local_observer(s, gains, bounds, options.kappa))


def _coupled(network: _Network, scenario: Scenario, progress: Progress) -> _Coupled:
    """The network with the coupling gain of the file, or the one that ``auto`` finds."""
    progress("choosing the coupling")
    h = scenario.plant.step
    steps = network.steps(h)

    def rho(c: float, at: float) -> float:
        return network.radius(c, steps if at == h else network.steps(at))

    return _Coupled(network, steps, choose_gain("c", network.options.c, network.growth, rho, h, network.laplacian))


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of the sampled errors of graph.ids with the designed gains on another graph."""
    n, blocks = design.scenario.plant.n, []
    for i in graph.ids:
        M = design.nodes[i].matrices
        blocks.append(Coupled(M["Phi"], M["K"], np.eye(n), M["Os"][:n]))
    return spectral_radius(error_system(blocks, graph.laplacian()))


def _unknown_input(scenario: Scenario) -> tuple[Array, list[str]]:
    """D (n, q) and its columns' names: what no node knows."""
    plant = scenario.plant
    if plant.time != "continuous":
        raise DesignError("reduced_order needs a continuous plant (time: continuous, and step: under run)")
    known = {i: frozenset(node.knows) for i, node in scenario.nodes.items()}
    first = next(iter(known))
    for i, names in known.items():
        if names != known[first]:
            raise DesignError(
                f"reduced_order reconstructs one unknown input at every node, so all nodes must know the same inputs; "
                f"node {first} knows {sorted(known[first])}, node {i} knows {sorted(names)}"
            )
    D = scenario.unknown(first)
    unknown = [name for name in plant.inputs if name not in known[first]]
    unknown += [f"disturbance {k + 1}" for k in range(plant.E.shape[1])]
    lengths = np.linalg.norm(D, axis=0)
    seen = np.linalg.svd(D / np.where(lengths > 0, lengths, 1.0), compute_uv=False)  # whatever the inputs' units
    if D.shape[1] and (D.shape[1] > plant.n or seen[-1] <= 1e-9 * seen[0]):
        raise DesignError(
            f"the unknown inputs ({', '.join(unknown)}) do not enter independently: singular values of D "
            f"(columns of length 1) are {np.array2string(seen, precision=3)}; combine dependent columns"
        )
    return D, unknown


def _bounds(options: Options, q: int) -> tuple[Array, Array]:
    bounds = options.bounds or ((-5.0, 5.0),) * q
    if len(bounds) != q or any(low >= high for low, high in bounds):
        raise DesignError(f"observer.bounds: one [low, high] with low < high for each of the {q} unknown inputs")
    low, high = np.array(bounds).reshape(q, 2).T
    return low, high


def _jointly_detectable(scenario: Scenario, D: Array, separated: Mapping[int, Separated], unknown: list[str]) -> None:
    """Assumption 1: all nodes' noise-free measurements together leave no unstable invariant zero.

    A rank condition, so no gain is computed. Raises DesignError with the modes that are left.
    """
    plant = scenario.plant
    C = np.vstack([np.vstack([s.W1, s.W2]) @ scenario.nodes[i].C for i, s in separated.items()])
    s = separate(Model(plant.A, plant.B, D, C, np.zeros((C.shape[0], 0))), "all nodes together", unknown)
    try:
        left = detectability_decomposition(s.C22, s.A22, hidden_from(0.0)).eigenvalues
    except GeometryError as e:
        raise DesignError(f"all nodes together: {e}") from None
    if left.size:
        raise DesignError(
            f"Assumption 1 fails: with the unknown inputs acting, all measurements together do not show the modes at "
            f"{modes(left)} (Re >= 0), where rank [sI - A, D; C~, 0] < n + q"
        )


def _network(graph: Graph, L: Array, nodes: Mapping[int, _Node], sigma: float) -> tuple[float | None, float | None]:
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


def _conditions(nodes: Mapping[int, _Node], spread: float | None) -> dict[str, dict[str, Any]]:
    weakest = min(node.separated.margin for node in nodes.values())
    found: dict[str, dict[str, Any]] = {
        "assumption_1": {"value": 0, "threshold": "0 modes with Re >= 0 hidden from all nodes together", "ok": True},
        "assumption_2": {"value": weakest, "threshold": f"> {1 / WORST_CONDITION:g}", "ok": True},
    }
    if spread is not None:
        found["network"] = {"value": spread, "threshold": "> 0: least eigenvalue of Y'(L^ kron I)Y", "ok": True}
    return found


def _facts(node: _Node) -> dict[str, Any]:
    s, gains = node.separated, node.gains
    return {
        "unknown_input_margin": s.margin,
        "left_to_network": int(gains.Tu.shape[1]),
        "left_to_network_modes": modes(gains.undetectable),
        "own_abscissa": float(gains.own.real.max()) if gains.own.size else None,
        "gain_norm": norm(gains.N),
        "state_error_in_unknown_input": node.bounds.amplification,
    }


def _spec(scenario: Scenario, i: int, node: _Node, step: Step, c: float) -> NodeSpec:
    """Everything that a tick needs, combined: state s = [z2-hat; eta+], output [x-hat; alpha; v-hat] = Os s + Oy y."""
    options: Options = scenario.options
    s, bounds, sensor = node.separated, node.bounds, scenario.nodes[i]
    q, k = s.W1.shape[0], s.A22.shape[0]
    width = bounds.width / options.kappa  # delta of (16), which starts at its equilibrium and stays there
    to_x = np.hstack([s.V2, np.zeros((s.V2.shape[0], q))]), s.U1 @ np.linalg.solve(s.C11, s.W1)
    to_alpha = np.hstack([np.zeros((q, k)), np.diag(1 / width)]), -s.W1 / width[:, None]
    Fplus = np.linalg.pinv(sensor.noise.channel)
    to_v = -Fplus @ sensor.C @ to_x[0], Fplus - Fplus @ sensor.C @ to_x[1]
    inverse = np.linalg.inv(bounds.G)
    l0, l1 = 1.5 * np.sqrt(options.lipschitz), 1.1 * options.lipschitz
    matrices = {
        "Phi": step.Phi,
        "Gamma": step.Gamma,
        "K": c * step.K @ (s.V2 @ node.gains.Tu).T,
        "bias": step.bias,
        "Os": np.vstack([to_x[0], to_alpha[0], to_v[0]]),
        "Oy": np.vstack([to_x[1], to_alpha[1], to_v[1]]),
        "f0": inverse @ bounds.p_plus,
        "f_alpha": inverse * bounds.width,
        "f_rate": inverse * width,
        "W1": s.W1,
        "middle": width / 2,
    }
    return node_spec(scenario, i, matrices, {"q": q, "h": scenario.plant.step, "l0": float(l0), "l1": l1})
