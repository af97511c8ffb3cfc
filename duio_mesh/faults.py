"""Faults on purpose: what the network does to each frame, decided by the seed alone.

The fate of a frame is a function of (seed, rule, directed edge, step, round): a keyed hash of these is read as uniform
numbers. Nothing is drawn in sequence, so a node that knows only the faults of its own in-edges, and the oracle that
knows all, come to the same conclusion bit for bit, and a receiver in lockstep knows without waiting which frames never
come and which come late. Pure; no clock.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Collection, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias

Span: TypeAlias = tuple[int, int]
"""From this step up to, not including, that step."""

ALWAYS: Span = (0, 1 << 32)  # steps are unsigned 32-bit numbers on the wire
COUNTED = ("lost", "corrupt", "late", "duplicate")  # what a receiver counts of its in-edges' frames
MAX_DELAY = 1000  # steps or rounds

_KEY = struct.Struct("<IQQII")  # rule, source, target, step, round
_DRAWS = struct.Struct("<8Q")
_NO_ROUND = (1 << 32) - 1  # where the Gilbert-Elliott chain, which moves once per step, has its draws


class Burst(NamedTuple):
    """Gilbert-Elliott: each step the edge is good or bad, and loses a frame with that state's probability.

    The stationary probability of bad is worsen / (worsen + mend); a bad spell lasts 1 / mend steps on average.
    """

    worsen: float  # P(good -> bad) from one step to the next
    mend: float  # P(bad -> good)
    good: float  # loss while good
    bad: float  # loss while bad


@dataclass(frozen=True)
class Rule:
    """What happens on one directed edge in the steps from ``during[0]`` up to, not including, ``during[1]``."""

    number: int  # its place in the topology file; part of the key of its draws
    during: tuple[int, int] = ALWAYS
    loss: float = 0.0
    burst: tuple[float, ...] = ()  # the four numbers of a Burst, or none
    delay_steps: tuple[int, int] = (0, 0)  # least and most, uniform between
    delay_rounds: tuple[int, int] = (0, 0)
    duplicate: float = 0.0
    reorder: float = 0.0  # overtaken by the next frame: one round late
    corrupt: float = 0.0  # one bit flipped, which the frame check catches


@dataclass(frozen=True)
class NodeFault:
    """What happens to a whole process at the beginning of a step."""

    node: int
    what: Literal["kill", "pause", "restart"]
    step: int
    seconds: float = 0.0  # how long a pause lasts
    away: int = 0  # steps that the others go on without a node that is restarted


@dataclass(frozen=True)
class Incoming:
    """What one node may know of the faults: those of its own in-edges."""

    target: int = 0
    seed: int = 0
    rules: Mapping[int, tuple[Rule, ...]] = field(default_factory=dict)  # by in-neighbour; only those with rules
    absent: Mapping[int, tuple[Span, ...]] = field(default_factory=dict)  # by in-neighbour: steps without its process


@dataclass(frozen=True)
class Faults:
    """A scenario's faults."""

    seed: int = 0
    links: Mapping[tuple[int, int], tuple[Rule, ...]] = field(default_factory=dict)  # by (source, target)
    nodes: tuple[NodeFault, ...] = ()

    def into(self, target: int, hears: Collection[int] = ()) -> Incoming:
        """The faults of the edges into this node, and when those of its in-neighbours ``hears`` are not there."""
        rules = {s: rules for (s, t), rules in sorted(self.links.items()) if t == target}
        absent = {j: self.absences(j) for j in sorted(hears) if self.absences(j)}
        return Incoming(target, self.seed, rules, absent)

    def absences(self, node: int) -> tuple[Span, ...]:
        """The steps in which this node's process is not there, in order."""
        spans = [
            (fault.step, fault.step + fault.away if fault.what == "restart" else ALWAYS[1])
            for fault in self.of(node)
            if fault.what != "pause"
        ]
        return tuple(spans)

    def of(self, node: int) -> tuple[NodeFault, ...]:
        """What happens to this node, in order."""
        return tuple(sorted((fault for fault in self.nodes if fault.node == node), key=lambda fault: fault.step))

    def returns(self) -> Mapping[int, tuple[int, ...]]:
        """The nodes that come back, by the step from which on they are there again, both ascending."""
        found: dict[int, list[int]] = {}
        for fault in sorted(self.nodes, key=lambda fault: (fault.step + fault.away, fault.node)):
            if fault.what == "restart":
                found.setdefault(fault.step + fault.away, []).append(fault.node)
        return {k: tuple(ids) for k, ids in found.items()}

    def spoilt_by(self, source: int) -> Mapping[int, tuple[Rule, ...]]:
        """What a sender has to do itself on its out-edges: flip bits and send twice. All else the receiver decides."""
        found = {}
        for (s, t), rules in sorted(self.links.items()):
            if s == source and any(rule.corrupt or rule.duplicate for rule in rules):
                found[t] = tuple(Rule(r.number, r.during, corrupt=r.corrupt, duplicate=r.duplicate) for r in rules)
        return found


NO_FAULTS = Faults()
UNDISTURBED = Incoming()


class Fate(NamedTuple):
    """What happens to one frame. One that is lost or corrupt does not arrive, whatever else is said of it.

    One that is both is sent with its flipped bit, and refused.
    """

    lost: bool = False
    corrupt: bool = False
    bit: float = 0.0  # which bit flips, as a fraction of the frame's length
    steps: int = 0  # late by so many steps ...
    rounds: int = 0  # ... and then so many rounds
    duplicate: bool = False

    @property
    def arrives(self) -> bool:
        """Does a good frame reach the observer, on time or late?"""
        return not (self.lost or self.corrupt)

    @property
    def late(self) -> bool:
        """Does it arrive in a later exchange than its own?"""
        return bool(self.steps or self.rounds)


FINE = Fate()


class Edge:
    """One directed edge. Asking for frames in order is cheap; any order gives the same answers."""

    def __init__(self, seed: int, source: int, target: int, rules: Iterable[Rule]) -> None:
        self._secret = hashlib.blake2b(str(seed).encode(), digest_size=32, person=b"duio faults").digest()
        self._ends = (source, target)
        self._rules = tuple((rule, self._chain(rule)) for rule in rules)

    def fate(self, k: int, r: int) -> Fate:
        """Of the frame of step k, round r, under all rules that hold in this step: delays add, any loss loses."""
        lost = corrupt = duplicate = False
        bit, steps, rounds = 0.0, 0, 0
        for rule, chain in self._rules:
            if not rule.during[0] <= k < rule.during[1]:
                continue
            u = self._draws(rule.number, k, r)
            loss = rule.loss
            if chain is not None:
                loss = chain.loss(k)
                lost = lost or u[7] < rule.loss
            lost = lost or u[0] < loss
            if u[1] < rule.corrupt:
                corrupt, bit = True, u[2]
            steps += _between(rule.delay_steps, u[3])
            rounds += _between(rule.delay_rounds, u[4]) + (u[5] < rule.reorder)
            duplicate = duplicate or u[6] < rule.duplicate
        return Fate(lost, corrupt, bit, steps, rounds, duplicate)

    def _draws(self, number: int, k: int, r: int) -> tuple[float, ...]:
        """Eight independent uniform numbers in [0, 1)."""
        key = _KEY.pack(number, *self._ends, k, r)
        digest = hashlib.blake2b(key, digest_size=64, key=self._secret).digest()
        return tuple((n >> 11) * 2.0**-53 for n in _DRAWS.unpack(digest))

    def _chain(self, rule: Rule) -> _Chain | None:
        return _Chain(self, rule.number, Burst(*rule.burst)) if rule.burst else None

    def step_draw(self, number: int, k: int) -> float:
        """The uniform number of a whole step, for a Gilbert-Elliott chain."""
        return self._draws(number, k, _NO_ROUND)[0]


class _Chain:
    """The good or bad of one edge, step by step, without walking from step 0.

    The chain is driven by one uniform number per step, used so that some numbers lead to the same state whatever went
    before: below min(worsen, 1 - mend) to bad, from the larger of the two on to good. Looking back to the latest such
    step, 1 / (1 - |1 - worsen - mend|) steps away on average, gives the state. Step 0 is drawn from the stationary
    distribution.
    """

    def __init__(self, edge: Edge, number: int, burst: Burst) -> None:
        self._draw, self._number, self._burst = edge.step_draw, number, burst
        self._low, self._high = sorted((burst.worsen, 1.0 - burst.mend))
        self._flips = burst.worsen > 1.0 - burst.mend  # between the two numbers: to the other state, or stay
        self._step, self._bad = -1, False  # the latest answer

    def loss(self, k: int) -> float:
        """The probability of losing a frame in step k."""
        if k != self._step:
            self._step, self._bad = k, self._state(k)
        return self._burst.bad if self._bad else self._burst.good

    def _state(self, k: int) -> bool:
        bad, swaps = False, False
        for at in range(k, -1, -1):
            if at == self._step:
                bad = self._bad
                break
            u = self._draw(self._number, at)
            if at == 0:
                total = self._burst.worsen + self._burst.mend
                bad = u * total < self._burst.worsen
            elif self._low <= u < self._high:
                swaps ^= self._flips
                continue
            else:
                bad = u < self._low
            break
        return bad ^ swaps


def _between(ends: tuple[int, int], u: float) -> int:
    least, most = ends
    return least + int(u * (most - least + 1))


class Stamp(NamedTuple):
    """A frame: from whom, of which step and round."""

    source: int
    k: int
    r: int


class Arrivals(NamedTuple):
    """What reaches a node in one exchange."""

    on_time: tuple[int, ...]  # in-neighbours whose frame of this very step and round arrives, ascending
    held: tuple[int, ...]  # in-neighbours whose frame of this step and round arrives in a later exchange
    lost: tuple[int, ...]  # in-neighbours whose frame is lost on the way; a corrupt one is in none of these
    late: tuple[Stamp, ...]  # older frames that arrive now, oldest first


class Reception:
    """Which frames reach one node, exchange by exchange; the same object decides in the oracle and in the mesh."""

    def __init__(self, incoming: Incoming, hears: Iterable[int]) -> None:
        self._edges = {
            j: Edge(incoming.seed, j, incoming.target, incoming.rules[j]) if j in incoming.rules else None
            for j in sorted(hears)
        }
        self._absent = {j: incoming.absent.get(j, ()) for j in self._edges}
        self.gone: set[int] = set()
        """In-neighbours that are lost, without its having been planned; whoever notices adds and removes them."""
        self._tick = 0  # exchanges so far
        self._held: list[_Held] = []
        self.counts = dict.fromkeys(COUNTED, 0)
        """Frames so far, by what happened to them."""

    def without(self, j: int, k: int) -> bool:
        """Whether there is nobody at in-neighbour j's end in step k."""
        return j in self.gone or any(first <= k < after for first, after in self._absent[j])

    def give_up(self, j: int, came: Container[tuple[int, int]]) -> list[Stamp]:
        """In-neighbour j is lost: its frames on their long way that were never sent, because only ``came`` has come."""
        never = [h for h in self._held if h.stamp.source == j and (h.stamp.k, h.stamp.r) not in came]
        self._held = [h for h in self._held if h not in never]
        return [h.stamp for h in never]

    def next(self, k: int, r: int) -> Arrivals:
        """What arrives in the exchange of step k, round r. To be asked once per exchange, in order.

        A frame that is late by s steps and d rounds arrives in the d-th exchange after that of step k + s, round r.
        """
        on_time, held_back, lost = [], [], []
        for j, edge in self._edges.items():
            if self.without(j, k):
                continue
            fate = FINE if edge is None else edge.fate(k, r)
            self.counts["lost"] += fate.lost
            self.counts["corrupt"] += fate.corrupt
            self.counts["duplicate"] += fate.arrives and fate.duplicate
            if fate.arrives and fate.late:
                self._held.append(_Held(Stamp(j, k, r), k + fate.steps, fate.rounds))
                held_back.append(j)
                self.counts["late"] += 1
            elif fate.arrives:
                on_time.append(j)
            elif not fate.corrupt:
                lost.append(j)
        late: list[Stamp] = []
        for held in list(self._held):
            if held.tick is None and (k, r) >= (held.step, held.stamp.r):
                held.tick = self._tick + held.rounds
            if held.tick is not None and self._tick >= held.tick:
                self._held.remove(held)
                late.append(held.stamp)
        self._tick += 1
        return Arrivals(
            tuple(on_time), tuple(held_back), tuple(lost), tuple(sorted(late, key=lambda s: (s.k, s.r, s.source)))
        )


@dataclass
class _Held:
    """A frame on its long way."""

    stamp: Stamp
    step: int  # not before this step (and the stamp's round)
    rounds: int  # exchanges after that
    tick: int | None = None  # the exchange in which it arrives, once that can be told
