"""The contract between an observer and whoever drives it (``node.py`` over Zenoh, ``simulation.py`` in one process).

An observer is a pure step machine: no I/O, no clock, no randomness, numpy only. Step k goes

    observer.sample(y, u)                  # data of step k
    for r in range(observer.rounds):
        out = observer.message(r)          # for every out-neighbour, the same vector
        observer.exchange(r, received)     # {in-neighbour: vector of this very round}, ascending ids
    observer.estimate()                    # of x(k)

Under faults some neighbours are missing from ``received``, vectors of earlier rounds may be handed over before it, and
the newest estimate may be marked: see ``absence``.

The vector returned by ``message`` may be a buffer that the next call overwrites: senders copy it, receivers own theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeGuard

import numpy as np

from duio_mesh.arrays import Array

NOTHING: Array = np.zeros(0)


class Estimate(NamedTuple):
    """What a node knows after a step."""

    state: Array  # x-hat (n,)
    unknown_input: Array = NOTHING  # w-hat (q,) where the method reconstructs it
    noise: Array = NOTHING  # v-hat (r,) where the method reconstructs it
    flag: Array = NOTHING  # (1,) where messages can be missing: 1 marks an estimate that is not to be trusted, else 0


class Observer(Protocol):
    """One node's step machine."""

    @property
    def rounds(self) -> int:
        """Exchanges in the current step; read after ``sample`` (a step with a set-up phase may have more)."""
        ...

    def sample(self, y: Array, u: Array) -> None:
        """Take y_i(k) (p,) and the known inputs u_i(k) (m,)."""
        ...

    def message(self, r: int) -> Array:
        """The vector for the neighbours in round r."""
        ...

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """Use the neighbours' vectors of round r, in ascending order of id."""
        ...

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """Begin, instead of at zero, after a step of which others have the estimate x (n,), and y, u are the own data.

        Called at most once, before the first ``sample``, which is then of the next step.
        """
        ...

    def estimate(self) -> Estimate:
        """The estimate of x(k), valid once the step's exchanges are done; zeros of the right sizes before step 0."""
        ...


class BatchObserver(Observer, Protocol):
    """An observer without memory between its exchanges: ``spec.batch`` calls of ``sample``, then one set of rounds.

    The last batch of a run may be shorter.
    """

    def batch(self) -> Sequence[Estimate]:
        """The estimates of all samples since the last rounds, in order."""
        ...


def can_batch(observer: type[Observer]) -> TypeGuard[type[BatchObserver]]:
    """Whether this class of observers takes several steps at once."""
    return hasattr(observer, "batch")


def reader(observer: Observer) -> Callable[[], Sequence[Estimate]]:
    """How to read what a set of rounds has given: a batch where the observer makes one, else one estimate."""
    batch: Callable[[], Sequence[Estimate]] | None = getattr(observer, "batch", None)
    return batch or (lambda: (observer.estimate(),))
