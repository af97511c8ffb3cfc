"""What a topology file says once it is read: plain frozen tuples and arrays, no file positions, no parsing.

Letters are the papers': ``x+ = A x + B u + E w`` (or ``dx/dt``), ``y_i = C_i x + F_i v_i``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.faults import NO_FAULTS, Faults
from duio_mesh.spec import Outside

Signal: TypeAlias = tuple[Mapping[str, Mapping[str, float]], ...]
"""A sum of terms, each ``{kind: parameters}``; ``duio_mesh.dynamics.signal`` evaluates it. () is zero."""


class Normal(NamedTuple):
    """Initial state drawn from N(mean, diag(std)^2), one draw per run from the run's seed."""

    mean: Array  # (n,)
    std: Array  # (n,)


class Lqr(NamedTuple):
    """u = F (x - reference) with F the LQR gain of (A, B) for these weights."""

    Q: Array  # (n, n)
    R: Array  # (m, m)
    reference: Array  # (n,)


class Feedback(NamedTuple):
    """u = F (x - reference), F as given."""

    F: Array  # (m, n)
    reference: Array  # (n,)


class OpenLoop(NamedTuple):
    """u_j = signals[j](t); one signal per input."""

    signals: tuple[Signal, ...]


class Noise(NamedTuple):
    """v of y = C x + F v: ``channel`` F (p, r) and one signal per channel column. r = 0 is no noise."""

    channel: Array  # (p, r)
    signals: tuple[Signal, ...]  # r of them


@dataclass(frozen=True)
class Plant:
    """The plant: (A, B, E), its inputs' names, and what drives it."""

    time: Literal["discrete", "continuous"]
    step: float  # seconds between samples: the plant's ``period`` or, in continuous time, the run's ``step``
    A: Array  # (n, n)
    B: Array  # (n, m)
    E: Array  # (n, q)
    inputs: tuple[str, ...]  # m names, the columns of B
    x0: Array | Normal  # (n,)
    control: Lqr | Feedback | OpenLoop
    disturbance: tuple[Signal, ...]  # q of them

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])


@dataclass(frozen=True)
class Node:
    """One sensor: y_i = C_i x + F_i v_i, and the inputs it is told."""

    id: int
    C: Array  # (p, n)
    knows: tuple[str, ...]
    noise: Noise


class Arc(NamedTuple):
    """``source`` tells ``target`` with weight a_target,source > 0."""

    source: int
    target: int
    weight: float


@dataclass(frozen=True)
class Graph:
    """Who tells whom. An undirected edge is two arcs."""

    ids: tuple[int, ...]  # sorted
    arcs: tuple[Arc, ...]  # sorted by (source, target), no duplicates, no self-loops
    directed: bool

    def hears(self, i: int) -> dict[int, float]:
        """In-neighbours j of node i with their weights a_ij, in ascending order of j."""
        return {a.source: a.weight for a in self.arcs if a.target == i}

    def tells(self, i: int) -> tuple[int, ...]:
        """Out-neighbours of node i, ascending."""
        return tuple(a.target for a in self.arcs if a.source == i)

    def laplacian(self) -> Array:
        """(N, N) in the order of ``ids``: L = diag(row sums of W) - W with W[i, j] = a_ij (i hears j)."""
        at = {i: k for k, i in enumerate(self.ids)}
        W = np.zeros((len(self.ids), len(self.ids)))
        for source, target, weight in self.arcs:
            W[at[target], at[source]] = weight
        return np.diag(W.sum(axis=1)) - W

    def islands(self) -> tuple[tuple[int, ...], ...]:
        """Weakly connected components, each sorted, in the order of their smallest id."""
        left, found = set(self.ids), []
        touching: dict[int, set[int]] = {i: set() for i in self.ids}
        for source, target, _ in self.arcs:
            touching[source].add(target)
            touching[target].add(source)
        for start in self.ids:
            if start not in left:
                continue
            island, front = {start}, [start]
            while front:
                for j in touching[front.pop()] - island:
                    island.add(j)
                    front.append(j)
            left -= island
            found.append(tuple(sorted(island)))
        return tuple(found)


class Convergence(NamedTuple):
    """The verdict: every node's RMS error over the last fraction of the run is below ``rms_below``."""

    rms_below: float
    over_last: float


@dataclass(frozen=True)
class Run:
    """How long, from which seed, and when a wait counts as a failure."""

    steps: int
    seed: int
    convergence: Convergence
    deadline: float  # seconds a process waits for a message before the run fails
    window: int  # steps that the plant may be ahead of the slowest node
    batch: int = 1  # steps whose fusion travels as one block; estimates then come that many steps late
    on_node_loss: Literal["stop", "degrade", "restart"] = "stop"
    rejoin: Literal["warm", "cold"] = "warm"  # how a node that was replaced starts
    max_seconds: float | None = None  # wall clock, from the start of the processes
    inputs: bool = False  # every node keeps a tape of what its observer is given


class Timing(NamedTuple):
    """When steps happen."""

    mode: Literal["lockstep", "realtime"] = "lockstep"
    tick: float = 0.0  # wall seconds per step; 0: as long as it takes
    wait: float = 0.0  # seconds from a sample's arrival in which a node waits for its neighbours


LOCKSTEP = Timing()


class Security(NamedTuple):
    """Who may speak to the processes of a run (docs/security.md)."""

    mode: Literal["open", "password", "mtls"] = "open"
    keep: bool = False  # the credentials stay in the run folder
    exposed: bool = False  # an open run may listen where strangers can reach it


OPEN = Security()


class Host(NamedTuple):
    """One machine of a run over several."""

    address: str  # under which the others reach it
    listen: str  # IP address to listen on
    port: int  # the first one
    runs: tuple[str, ...]  # names of processes
    via: str  # routed: the host whose router this one's router dials; "" for the first


class Hosts(NamedTuple):
    """Who runs where (docs/deploy.md)."""

    by_name: Mapping[str, Host] = MappingProxyType({})  # in the order of the file
    routed: bool = False  # processes talk through one router per host


NO_HOSTS = Hosts()


@dataclass(frozen=True)
class Scenario:
    """A whole topology file, resolved."""

    name: str
    description: str
    plant: Plant
    method: str
    options: Any  # the method's own ``Options`` (synthesis/<method>.py)
    nodes: Mapping[int, Node]  # ascending ids
    graph: Graph
    run: Run
    document: Mapping[str, Any] = field(repr=False)  # the resolved file as plain data: what scenario.yaml is made of
    faults: Faults = NO_FAULTS
    security: Security = OPEN
    timing: Timing = LOCKSTEP
    outside: Outside | None = None  # the measurements come from outside: nobody knows the true state
    hosts: Hosts = NO_HOSTS

    @property
    def patchy(self) -> bool:
        """Whether messages can be missing, so that observers need to know what to do without them."""
        return bool(self.faults.links) or self.timing.mode == "realtime" or self.run.on_node_loss != "stop"

    def known(self, i: int) -> Array:
        """B_i (n, m_i): columns of B whose inputs node i is told, in the order of ``plant.inputs``."""
        names = set(self.nodes[i].knows)
        return self.plant.B[:, [j for j, name in enumerate(self.plant.inputs) if name in names]]

    def unknown(self, i: int) -> Array:
        """[B_i^u, E] (n, m - m_i + q): every input that node i is not told (seed 000, below (5))."""
        names = set(self.nodes[i].knows)
        hidden = self.plant.B[:, [j for j, name in enumerate(self.plant.inputs) if name not in names]]
        return np.hstack([hidden, self.plant.E])
