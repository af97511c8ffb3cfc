"""Records of a tape and a spec -> the estimates, block by block. Pure; no files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers import make_observer
from duio_mesh.observers.absence import Late, flagged, take_late
from duio_mesh.observers.base import Estimate, Observer, reader
from duio_mesh.spec import NodeSpec
from duio_mesh.tape import Arrival, Call, Exchange, Head, Read, Record, Sample


class Round(NamedTuple):
    """One exchange."""

    r: int
    own: Array  # the vector that the node told its neighbours
    received: Mapping[int, Array]
    late: tuple[Late, ...]  # handed over before it


@dataclass
class Block:
    """What happens between two readings of the estimates: one step, or as many as the observer fuses at once."""

    head: Head  # of the process that it belongs to
    first: int  # step
    before: Estimate | None  # the last estimate before this block; None where the process begins
    samples: list[Sample] = field(default_factory=list)
    calls: list[Call] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)  # only of watched blocks
    exchanged: int = 0  # how many rounds there were
    estimates: Sequence[Estimate] = ()  # one per sample; none when the tape ends, or the observer fails, before
    flagged: bool = False
    failure: Exception | None = None  # that the observer raised
    went_on: bool = False  # after the failure: so it did not fail in the run

    @property
    def steps(self) -> range:
        """The steps whose samples it holds."""
        return range(self.first, self.first + len(self.samples))

    @property
    def empty(self) -> bool:
        """Whether nothing has been given yet."""
        return not (self.samples or self.calls or self.exchanged)


Halt = Callable[[], None]


def play(
    spec: NodeSpec, records: Iterable[Record], watch: int | None = None, halt: Halt = lambda: None
) -> Iterator[Block]:
    """Give the observer of this spec everything that is on the tape.

    ``watch``: a step whose block keeps its rounds; ``halt`` is called right before that step's sample is given to the
    observer. What the observer raises is in the last block of its process. Raises ValueError when the tape is of
    another node, or does not fit the spec in its sizes, and whatever ``records`` raises.
    """
    player: _Player | None = None
    for record in records:
        if isinstance(record, Head):
            if player:
                yield from player.end()
            player = _Player(spec, record, watch, halt)
        elif player is None:
            raise ValueError("the tape does not begin with a head")
        elif done := player.give(record):
            yield done
    if player:
        yield from player.end()


class _Player:
    """One process of the node."""

    def __init__(self, spec: NodeSpec, head: Head, watch: int | None, halt: Halt) -> None:
        if head.node != spec.id:
            raise ValueError(f"the tape is of node {head.node}, the spec of node {spec.id}")
        self._spec, self._watch, self._halt = spec, watch, halt
        self._observer: Observer = make_observer(replace(spec, steps=head.steps))
        self._read = reader(self._observer)
        self._late: tuple[Late, ...] = ()
        self._block = Block(head, head.first, None)

    def give(self, record: Record) -> Block | None:
        """Carry out one record; the block, if that ends it."""
        block = self._block
        if block.failure is not None:
            block.went_on = True
            return None
        self._check(record)
        try:
            self._carry_out(record)
        except Exception as e:  # whatever it is, it is what the user wants to see
            block.failure = e
            return None
        if not isinstance(record, Read):
            return None
        if len(block.estimates) != len(block.samples):
            raise ValueError(
                f"the tape does not fit the spec: {len(block.samples)} samples before the estimates of step "
                f"{block.first} are read, but the observer gives {len(block.estimates)}"
            )
        self._block = Block(block.head, block.steps.stop, block.estimates[-1])
        return block

    def end(self) -> Iterator[Block]:
        """The block that was never finished, if anything of it is there."""
        if not self._block.empty or self._block.failure:
            yield self._block

    def _carry_out(self, record: Record) -> None:
        observer, block = self._observer, self._block
        match record:
            case Sample(y, u):
                if block.steps.stop == self._watch:
                    self._halt()
                block.samples.append(record)
                observer.sample(y, u)
            case Arrival(late):
                self._late += late
                take_late(observer, late)
            case Exchange(r, received):
                block.exchanged += 1
                own = observer.message(r)
                if self._watch in block.steps:
                    block.rounds.append(Round(r, own.copy(), received, self._late))
                self._late = ()
                observer.exchange(r, received)
            case Call(name, arguments):
                block.calls.append(record)
                getattr(observer, name)(*arguments)
            case Read():
                block.estimates = [Estimate(*map(np.array, estimate)) for estimate in self._read()]
                block.flagged = flagged(observer)

    def _check(self, record: Record) -> None:
        """Raise ValueError where the tape cannot be one of this spec."""
        spec, k = self._spec, self._block.steps.stop
        if isinstance(record, Sample) and (record.y.size, record.u.size) != (spec.p, spec.m):
            raise ValueError(
                f"the tape does not fit the spec: step {k} has {record.y.size} measurements and {record.u.size} known "
                f"inputs, the spec says {spec.p} and {spec.m}"
            )
        if isinstance(record, Exchange) and not record.received.keys() <= spec.hears.keys():
            strangers = sorted(record.received.keys() - spec.hears.keys())
            raise ValueError(f"the tape does not fit the spec: the spec does not hear node(s) {strangers}")
