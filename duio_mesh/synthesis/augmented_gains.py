"""From what the file says under ``gains:`` to every node's gains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.scenario.model import Scenario
from duio_mesh.scenario.schema import Matrix
from duio_mesh.synthesis.augmented_channel import Compensator, Fixed, NoCompensator, brasch_pearson, channel_gains, lqg
from duio_mesh.synthesis.augmented_error import ErrorSystem, Gains, Network
from duio_mesh.synthesis.augmented_existence import components
from duio_mesh.synthesis.augmented_h2 import NothingFound, h2_gains
from duio_mesh.synthesis.augmented_options import H2, BraschPearson, Channel, FixedNode, GivenNode, Options
from duio_mesh.synthesis.design import Progress


class Found(NamedTuple):
    """The gains of all nodes, in the order of their ids, and which method they are from."""

    gains: list[Gains]
    method: str
    note: str = ""
    """Why it is not the method of the file."""


def find_gains(scenario: Scenario, network: Network, options: Options, progress: Progress) -> Found:
    """The gains of all nodes by the chosen method, or by ``lqg`` where ``h2`` finds none; not yet verified.

    Raises DesignError for given matrices of wrong shape or unknown nodes, or when the method finds nothing.
    """
    try:
        return Found(_by_method(scenario, network, options, progress), options.name)
    except NothingFound as e:
        if options.delay:
            raise DesignError(f"{e} Raise h2.starts or h2.extra_states.") from None
        if _given_orders(options):
            raise DesignError(f"{e} Use gains: lqg, or raise h2.starts or h2.extra_states.") from None
        progress(f"gains: h2 found none; trying lqg ({e})")
        return Found(_instead(scenario, network, options, progress, str(e)), "lqg", f"{e} Those of lqg are taken.")


def _given_orders(options: Options) -> bool:
    """Whether the file says how many states a node may add; lqg would not keep to that."""
    chosen = options.chosen()
    return isinstance(chosen, H2) and "extra_states" in chosen.model_fields_set


def _instead(scenario: Scenario, network: Network, options: Options, progress: Progress, refused: str) -> list[Gains]:
    """The gains of ``gains: lqg``, when they reach the rate. Raises DesignError with both methods' reasons."""
    advice = "Use gains: lqg with more tries, or raise h2.starts or h2.extra_states."
    try:
        gains = _lqg(scenario, network, Channel(), options.rate, progress)
    except NoCompensator:
        raise DesignError(f"{refused} gains: lqg, tried next, finds none either. {advice}") from None
    system = ErrorSystem(network, [len(g.S) for g in gains])
    radius = spectral_radius(system.matrix(system.theta(gains)))
    if radius >= options.rate:
        raise DesignError(f"{refused} gains: lqg, tried next, has the spectral radius {radius:.4g}. {advice}")
    return gains


def _by_method(scenario: Scenario, network: Network, options: Options, progress: Progress) -> list[Gains]:
    chosen, ids = options.chosen(), tuple(scenario.nodes)
    if isinstance(chosen, tuple):
        at = _by_node(chosen, ids, "given")
        missing = [i for i in ids if i not in at]
        if missing:
            raise DesignError(f"observer.gains.given: no gains for node {_list(missing)}")
        return [_given(chosen[at[i]], network, k, f"given.{at[i]}") for k, i in enumerate(ids)]
    if isinstance(chosen, H2):
        return h2_gains(
            network, _orders(chosen, len(ids)), chosen.transient, options.rate, chosen.starts, chosen.seed, progress
        )
    if options.delay:
        raise DesignError("observer.delay: 1 is designed by gains: h2 only")
    if isinstance(chosen, BraschPearson):
        return _through_channels(scenario, network, chosen, (1.0,), brasch_pearson(chosen.radius), progress)
    return _lqg(scenario, network, chosen, options.rate, progress)


def _lqg(scenario: Scenario, network: Network, chosen: Channel, rate: float, progress: Progress) -> list[Gains]:
    return _through_channels(scenario, network, chosen, (0.1, 0.3, 1.0), lqg(rate), progress)


def given_H(options: Options, i: int, C: Array, basis: Array) -> Array | None:
    """H_i (n, p) from the file, None when it says nothing. Raises DesignError when H C D differs from D (13)."""
    chosen = options.chosen()
    written = next((own.H for own in chosen if own.node == i), None) if isinstance(chosen, tuple) else None
    if written is None:
        return None
    H = _matrix(written, C.shape[::-1], f"given: node {i}: H")
    if np.abs(H @ C @ basis - basis).max(initial=0.0) > 1e-9:
        raise DesignError(f"observer.gains.given: node {i}: H violates (13): H C D differs from D")
    return H


def _orders(chosen: H2, nodes: int) -> list[int]:
    orders = chosen.extra_states
    if isinstance(orders, int):
        return [orders] * nodes
    if len(orders) != nodes:
        raise DesignError(
            f"observer.gains.h2.extra_states should have {nodes} entries (one per node), not {len(orders)}"
        )
    return orders


def _given(written: GivenNode, network: Network, k: int, name: str) -> Gains:
    n, p = network.n, len(network.sensors[k].C)
    beta = len(written.S or ())
    return Gains(
        F=_matrix(written.F, (n, p), f"{name}.F"),
        K=_matrix(written.K, (n, n), f"{name}.K"),
        Q=_matrix(written.Q, (n, beta), f"{name}.Q") if beta or written.Q else np.zeros((n, 0)),
        R=_matrix(written.R, (beta, n), f"{name}.R") if beta or written.R else np.zeros((0, n)),
        S=_matrix(written.S, (beta, beta), f"{name}.S") if beta else np.zeros((0, 0)),
    )


def _through_channels(
    scenario: Scenario,
    network: Network,
    chosen: Channel,
    spreads: tuple[float, ...],
    compensator: Compensator,
    progress: Progress,
) -> list[Gains]:
    ids, n = tuple(scenario.nodes), network.n
    if chosen.channel is not None and chosen.channel not in ids:
        raise DesignError(f"observer.gains: channel names node {chosen.channel}; the nodes are {_list(ids)}")
    p = {i: len(s.C) for i, s in zip(ids, network.sensors, strict=True)}
    named = [(chosen.fixed[at], f"fixed.{at}") for at in _by_node(chosen.fixed, ids, "fixed").values()]
    fixed = Fixed(
        ids=ids,
        channel=chosen.channel,
        F={own.node: _matrix(own.F, (n, p[own.node]), f"{name}.F") for own, name in named if own.F is not None},
        K={own.node: _matrix(own.K, (n, n), f"{name}.K") for own, name in named if own.K is not None},
        spreads=spreads,
        tries=chosen.tries,
        seed=chosen.seed,
    )
    return channel_gains(network, components(scenario.graph), fixed, compensator, progress)


def _by_node(written: Sequence[GivenNode | FixedNode], ids: tuple[int, ...], name: str) -> dict[int, int]:
    """Where each node stands in the list."""
    at: dict[int, int] = {}
    for k, own in enumerate(written):
        if own.node not in ids:
            raise DesignError(f"observer.gains: {name}.{k} names node {own.node}; the nodes are {_list(ids)}")
        if own.node in at:
            raise DesignError(f"observer.gains: {name} names node {own.node} twice")
        at[own.node] = k
    return at


def _list(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids))


def _matrix(written: Matrix | None, shape: tuple[int, int], name: str) -> Array:
    rows = written or []
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise DesignError(f"observer.gains: {name} should be {shape[0]} x {shape[1]}")
    return np.array(rows, dtype=np.float64).reshape(shape)
