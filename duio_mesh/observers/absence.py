"""What an observer does without a neighbour: its policy, and the mark that says when not to trust the estimate.

Where messages can be missing, ``make_observer`` puts a guard around the method's own step machine. The guard decides
what the machine is given in place of what did not come, and every message carries one number more: the sender's
*doubt*, which tells nodes that have heard everybody that somebody else has not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers.base import Estimate, Observer, reader
from duio_mesh.observers.watch import watcher
from duio_mesh.spec import NodeSpec

PATIENCE = 5  # steps (relaxed fusion: rounds) without a neighbour that are bridged without a flag
MISS = 3  # a neighbour that misses more than one in 1 + MISS exchanges is as good as silent
HELD = 1000.0  # steps that the bias of a stale vector is taken to last
UNSETTLED = 0.5  # of a doubt: the fusion is right, but not what goes into it
MEMORY = 64  # own messages that are kept to be paired with late ones


class Late(NamedTuple):
    """A vector that arrives after the exchange that it was sent for."""

    source: int
    steps: int  # older than the present step by so many
    round: int  # of its own step
    vector: Array


def take_late(observer: Observer, arrived: Sequence[Late]) -> None:
    """Hand over late vectors, oldest first, before the same round's ``exchange``. Without a guard they are dropped."""
    late: Callable[[Sequence[Late]], None] | None = getattr(observer, "late", None)
    if arrived and late is not None:
        late(arrived)


def flagged(observer: Observer) -> bool:
    """Whether the newest estimate is not to be trusted: messages were missing that the policy cannot replace."""
    return bool(getattr(observer, "flagged", False))


def greeting(estimate: Estimate) -> Array:
    """What a node tells a neighbour that comes back: its estimate of x (n,) and the mark."""
    return np.append(estimate.state, estimate.flag)


def start_again(observer: Observer, told: Sequence[Array], data: Array, p: int) -> None:
    """Begin after a step with the mean of the neighbours' greetings (n + 1,) and the own data [y; u], p numbers in y.

    Where nobody has told anything it begins from nothing.
    """
    if not told:
        _call(observer, "distrust")
        return
    mean = sum(told[1:], told[0]) / len(told)
    observer.resume(mean[:-1], data[:p], data[p:])
    if mean[-1]:
        _call(observer, "mistrust")


def part_with(observer: Observer, j: int) -> None:
    """Tell the observer that neighbour j's process is gone: nothing will come until ``welcome``."""
    _call(observer, "part_with", j)


def welcome(observer: Observer, j: int) -> None:
    """Tell the observer that neighbour j is there again, from the coming exchange on."""
    _call(observer, "welcome", j)


def _call(observer: Observer, name: str, *arguments: int) -> None:
    """What only a guard understands."""
    method: Callable[..., None] | None = getattr(observer, name, None)
    if method is not None:
        method(*arguments)


class Silence:
    """How badly a node's neighbours are missed: one leaky account each.

    An exchange without the neighbour adds MISS, one with it takes 1 away. What is above MISS * PATIENCE is the doubt:
    the number of complete exchanges after which it is over, MISS times as many as were missed. Losses below a quarter
    hardly ever reach it, and then briefly. Errors may grow faster than they decay: an unstable plant's observer was
    seen to need twice as long to recover as it had been alone.
    """

    def __init__(self, ids: Iterable[int]) -> None:
        self._level = dict.fromkeys(ids, 0)

    def note(self, heard: Container[int], excused: Container[int] = ()) -> float:
        """After an exchange: the doubt about the worst neighbour; who is excused counts as heard."""
        for j, level in self._level.items():
            self._level[j] = max(0, level - 1) if j in heard or j in excused else level + MISS
        return float(max(0, max(self._level.values(), default=0) - MISS * PATIENCE))


class _Guard:
    """A step machine of its own around another one; one number more per message."""

    def __init__(self, inner: Observer, spec: NodeSpec) -> None:
        self._inner, self._hears = inner, tuple(sorted(spec.hears))
        self._policy = spec.without
        self._excuses, self._excused, self._parted = spec.excuses, set[int](), set[int]()
        self._doubt = 0.0  # about what the neighbours have said
        self._settling, self._unsettled = spec.settling, 0  # steps that a late beginning takes, and that are left of it
        self._late: list[Late] = []

    @property
    def rounds(self) -> int:
        """As the method has."""
        return self._inner.rounds

    def message(self, r: int) -> Array:
        """The method's vector, then the doubt."""
        return np.append(self._inner.message(r), max(self._doubt, float(self._unsettled)))

    @property
    def flagged(self) -> bool:
        """Is the newest estimate marked?"""
        return self._doubt > 0 or self._unsettled > 0

    def watched(self) -> Array:
        """What the method has kept of its rounds."""
        return watcher(self._inner)()

    def late(self, arrived: Sequence[Late]) -> None:
        """Vectors of earlier exchanges that arrive in the coming one."""
        self._late.extend(arrived)

    def part_with(self, j: int) -> None:
        """Neighbour j is gone. When the design allows for that, its silence is no reason to doubt.

        Two at once are more than ``spec.excuses`` speaks of: then nobody is excused.
        """
        self._parted.add(j)
        self._excused = self._parted & set(self._excuses) if len(self._parted) == 1 else set()

    def welcome(self, j: int) -> None:
        """Neighbour j is back."""
        self._parted.discard(j)
        self._excused = self._parted & set(self._excuses) if len(self._parted) == 1 else set()

    def distrust(self) -> None:
        """This node begins late and from nothing: its errors need ``spec.settling`` steps."""
        self._unsettled = self._settling

    def mistrust(self) -> None:
        """It begins from estimates that were marked; whoever marked them says in the next exchange for how long."""

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """As the method does."""
        self._inner.resume(x, y, u)

    def estimate(self) -> Estimate:
        """As the method has, and the mark."""
        return self._marked(self._inner.estimate())

    def _marked(self, estimate: Estimate) -> Estimate:
        return estimate._replace(flag=np.array([float(self.flagged)]))


class Coupled(_Guard):
    """Of the methods that exchange x-hat once per step and pull it towards the neighbours' (seeds 000, 001, 003, 004).

    ``skip`` leaves the edge out of the step. ``hold`` takes the latest vector that ever came, which pulls to where the
    plant was: flagged from the first time on. ``pair`` compares a late vector with the own one of the same step: it
    adds that difference to the present own vector, so that the method sees just the difference; an edge with nothing
    new is left out. A design without delays stands a small one in continuous time only (see docs/reliability.md), so a
    vector that is more than ``paired`` steps late counts as missing all the same.

    The estimate is flagged while ``Silence`` doubts a neighbour; who hears of a doubt of d steps has one of d - 1.
    """

    def __init__(self, inner: Observer, spec: NodeSpec) -> None:
        super().__init__(inner, spec)
        self._silence = Silence(self._hears)
        self._paired = 1 if spec.method in ("geometric", "reduced_order") else 0
        self._last: dict[int, tuple[int, Array]] = {}  # for hold: the newest vector and its age
        self._said: deque[Array] = deque(maxlen=MEMORY)  # own vectors, newest first

    def sample(self, y: Array, u: Array) -> None:
        """As the method does."""
        self._unsettled = max(0, self._unsettled - 1)
        self._inner.sample(y, u)

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """The method's exchange, with what the policy puts in place of what is missing."""
        own = self._inner.message(r)
        vectors = {j: vector[:-1] for j, vector in received.items()}
        told = max((vector[-1] for vector in received.values()), default=0.0)
        self._said.appendleft(own.copy())
        usable = self._replaced(own, vectors)
        timely = {late.source for late in self._late if self._policy == "pair" and late.steps <= self._paired}
        self._late.clear()
        stale = self._policy == "hold" and len(usable) > len(vectors)
        silent = self._silence.note(vectors.keys() | timely, self._excused)
        self._doubt = max(silent, told - 1, self._doubt - 1, HELD if stale else 0.0, 0.0)
        self._inner.exchange(r, usable)

    def _replaced(self, own: Array, heard: dict[int, Array]) -> dict[int, Array]:
        """The vectors that the method gets, in ascending order of id."""
        found = dict(heard)
        if self._policy == "hold":
            self._last = {j: (age + 1, vector) for j, (age, vector) in self._last.items()}
            for j, steps, _, vector in self._late:
                if j not in self._last or steps < self._last[j][0]:
                    self._last[j] = (steps, vector[:-1])
            self._last |= {j: (0, vector) for j, vector in heard.items()}
            found = {j: vector for j, (_, vector) in self._last.items() if j not in self._parted}
        elif self._policy == "pair":
            for j, steps, _, vector in self._late:  # oldest first: the newest stays
                if j not in heard and steps < len(self._said):
                    found[j] = own + (vector[:-1] - self._said[steps])
        return {j: found[j] for j in self._hears if j in found}


class Fused(_Guard):
    """Of the method that fuses anew in every step (seed 002): nothing is carried over, one whole step is in doubt.

    Within a step the newest vector of a neighbour stands for a missing one; before it was heard at all, it is taken
    to agree with this node. ``hold`` gives the result as it comes out; ``predict`` gives A x-hat + B_i u_i of the step
    before instead when the step is in doubt (it knows nothing of the unknown inputs, and stays flagged). ``auto`` is
    predict for finite-time averaging, where a missing message leaves nothing of the result, and hold for the others.

    Linearised ADMM and finite-time averaging need every message, so one that is missing anywhere makes the step
    doubtful, and the doubt travels as fast as the harm, one hop per round. The relaxed fusion forgets what was lost: a
    step is in doubt while ``Silence``, counting rounds, doubts a neighbour; it shrinks by one per round.
    """

    def __init__(self, inner: Observer, spec: NodeSpec) -> None:
        super().__init__(inner, spec)
        fusion, distributed = spec.options["fusion"], spec.options["setup"] == "distributed"
        self._exact = fusion != "relaxed"
        self._set_up = len(spec.options["eigenvalues"]) if distributed else 0  # rounds that forgive nothing
        self._silence = Silence(self._hears)
        self._newest: dict[int, tuple[int, Array]] = {}  # round and vector, of this step
        self._results: list[Estimate] = []
        self._inputs: list[Array] = []
        self._before: Array | None = None  # the known inputs of the sample before this step's first
        self._AB: Array | None = None
        if self._policy == "predict" or (self._policy == "auto" and fusion == "finite_time"):
            self._AB = np.hstack([spec.matrices["A"], spec.matrices["B"]])
        self._x = np.zeros(spec.n)

    def message(self, r: int) -> Array:
        """The method's vector, then the doubt; what is only unsettled spoils no fusion, and counts for less than 1."""
        return np.append(self._inner.message(r), max(self._doubt, UNSETTLED * (self._unsettled > 0)))

    def mistrust(self) -> None:
        """It begins from estimates that were marked; its local estimate goes on from there, as from nothing."""
        self.distrust()

    def sample(self, y: Array, u: Array) -> None:
        """As the method does; the first sample after an estimate begins a step without doubt."""
        if self._results:
            self._x = self._results[-1].state.copy()
            self._before = self._inputs[-1]
            self._results, self._inputs, self._newest, self._doubt, self._set_up = [], [], {}, 0.0, 0
            self._silence = Silence(self._hears)
        self._inputs.append(u.copy())
        self._unsettled = max(0, self._unsettled - 1)
        self._inner.sample(y, u)

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """The method's exchange, with the newest vectors in place of missing ones."""
        heard = {j: vector[:-1] for j, vector in received.items()}
        if r < self._set_up:
            self._late.clear()
            self._inner.exchange(r, heard)
            return
        own = self._inner.message(r)
        for j, steps, round_, vector in self._late:
            if steps == 0 and round_ >= self._set_up and (j not in self._newest or round_ > self._newest[j][0]):
                self._newest[j] = (round_, vector[:-1])
        self._late.clear()
        self._newest |= {j: (r, vector) for j, vector in heard.items()}
        told = max((vector[-1] for vector in received.values()), default=0.0)
        self._doubt = self._doubted(heard, told)
        given = {j: self._newest[j][1] if j in self._newest else own for j in self._hears}
        self._inner.exchange(r, given)

    def _doubted(self, heard: Mapping[int, Array], told: float) -> float:
        unsettled = UNSETTLED * (
            told % 1 > 0 or self._doubt % 1 > 0
        )  # as fast as the fusion carries what it comes from
        if self._exact:
            missed = any(j not in heard and j not in self._excused for j in self._hears)
            return 1.0 if missed or told >= 1 or self._doubt >= 1 else unsettled
        return max(self._silence.note(heard, self._excused), told - 1, self._doubt - 1, unsettled)

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """As the method does; x-hat and the inputs of the step before are what ``predict`` goes on from."""
        self._inner.resume(x, y, u)
        self._x, self._before = x.copy(), u.copy()

    def estimate(self) -> Estimate:
        """Of the newest sample."""
        return self._results[-1] if self.batch() else super().estimate()

    def batch(self) -> Sequence[Estimate]:
        """Of every sample since the last rounds."""
        if not self._results and self._inputs:
            doubtful = self._AB is not None and self._doubt >= 1
            found = self._predicted() if doubtful else [e.state.copy() for e in reader(self._inner)()]
            self._results = [self._marked(Estimate(x)) for x in found]
        return self._results

    def _predicted(self) -> list[Array]:
        """A x-hat + B_i u_i from the last step's estimate on, for every sample of this one."""
        assert self._AB is not None  # noqa: S101
        found = [self._x if self._before is None else self._AB @ np.append(self._x, self._before)]
        for u in self._inputs[:-1]:
            found.append(self._AB @ np.append(found[-1], u))
        return found


def guarded(inner: Observer, spec: NodeSpec) -> Observer:
    """The observer with its guard, where messages can be missing; otherwise the observer itself."""
    if not spec.without:
        return inner
    return Fused(inner, spec) if spec.method == "admm" else Coupled(inner, spec)
