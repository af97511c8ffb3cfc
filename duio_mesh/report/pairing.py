"""Which rows have arrived, and the error of every step of which both the truth and an estimate have. Pure numpy.

Rows come in batches, in any order, from processes that may be far apart; memory stays bounded however long a run is.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array

Span: TypeAlias = tuple[int, int]
"""Steps first .. last-1."""

MEMORY = 32 << 20  # bytes that wait for their counterpart
FLOOR, CEILING = -16.0, 308.0  # of log10: below is rounding, above is not a float64


class Spans:
    """A set of steps as disjoint, sorted spans."""

    def __init__(self) -> None:
        self._first: list[int] = []
        self._last: list[int] = []

    def add(self, first: int, last: int) -> None:
        """Add the steps first .. last-1."""
        if first >= last:
            return
        # every span that overlaps or touches [first, last] melts into it
        low, high = bisect_left(self._last, first), bisect_right(self._first, last)
        if low < high:
            first, last = min(first, self._first[low]), max(last, self._last[high - 1])
        self._first[low:high], self._last[low:high] = [first], [last]

    def gaps(self, first: int, last: int) -> list[Span]:
        """What of first .. last-1 is not in the set."""
        found = []
        for at in range(bisect_right(self._last, first), len(self._first)):
            if self._first[at] >= last:
                break
            if first < self._first[at]:
                found.append((first, self._first[at]))
            first = self._last[at]
        if first < last:
            found.append((first, last))
        return found

    def __iter__(self) -> Iterator[Span]:
        return iter(zip(self._first, self._last, strict=True))


class Errors(NamedTuple):
    """Error norms of one node that have just become known."""

    node: int
    steps: NDArray[np.int64]  # (m,) ascending
    log10: Array  # (m,) of the 2-norm of x-hat - x


class Pairing:
    """Keeps the newest truths and the estimates that came before theirs; says every error as soon as it is known.

    Both wait in rings of ``window`` steps: a row that found no counterpart in that time is forgotten, and its step
    counts as missing until both rows are given again.
    """

    def __init__(self, n: int, nodes: Iterable[int], steps: int) -> None:
        ids = list(nodes)
        self._n = n
        self.window = max(1, min(steps, max(256, MEMORY // (8 * n * (len(ids) + 1)))))
        self.known = {i: Spans() for i in ids}  # steps whose error has been said
        self._truth = _Ring(self.window, n)
        self._early = {i: _Ring(self.window, n) for i in ids}

    def truth(self, k: int, rows: Array) -> list[Errors]:
        """True states (m, n) of the steps from k on: the errors of the nodes that were ahead."""
        said = []
        for first in range(0, len(rows), self.window):
            part = rows[first : first + self.window]
            steps = np.arange(k + first, k + first + len(part))
            self._truth.put(steps, part)
            for i, ring in self._early.items():
                there = ring.has(steps)
                if there.any():
                    said.append(self._say(i, steps[there], ring.take(steps[there]), part[there]))
        return said

    def estimates(self, node: int, k: int, rows: Array) -> Errors:
        """Estimates (m, n) of the steps from k on: the errors of those whose truth is here; the others wait."""
        steps = np.arange(k, k + len(rows))
        there = self._truth.has(steps)
        for first in range(0, len(rows), self.window):
            part = slice(first, first + self.window)
            early = ~there[part]
            self._early[node].put(steps[part][early], rows[part][early])
        return self._say(node, steps[there], rows[there], self._truth.get(steps[there]))

    def _say(self, node: int, steps: NDArray[np.int64], estimates: Array, truth: Array) -> Errors:
        for first, last in runs(steps):
            self.known[node].add(first, last)
        with np.errstate(over="ignore", invalid="ignore"):  # an observer that diverged; the norm says so
            return Errors(node, steps, log_norms(estimates - truth))


class Middle(Pairing):
    """In the truth's place, where nobody knows it, the mean of all estimates: a step is known when all are here.

    Or when it is certain that no further one comes.
    """

    def together(self, node: int, k: int, rows: Array) -> list[Errors]:
        """Estimates (m, n) of the steps from k on: all nodes' distances in the steps that are complete with them."""
        said = []
        for first in range(0, len(rows), self.window):
            part = rows[first : first + self.window]
            steps = np.arange(k + first, k + first + len(part))
            self._early[node].put(steps, part)
            said += self._close(steps[np.all([ring.has(steps) for ring in self._early.values()], axis=0)])
        return said

    def rest(self, first: int, last: int) -> list[Errors]:
        """No further estimate of the steps first .. last-1 comes: the distances of those that are here."""
        steps = np.arange(first, last)
        return self._close(steps[np.any([ring.has(steps) for ring in self._early.values()], axis=0)])

    def _close(self, steps: NDArray[np.int64]) -> list[Errors]:
        """The distances of these steps' estimates from their mean."""
        total, count = np.zeros((len(steps), self._n)), np.zeros((len(steps), 1))
        with np.errstate(over="ignore", invalid="ignore"):
            for ring in self._early.values():
                there = ring.has(steps)[:, None]
                total, count = total + np.where(there, ring.get(steps), 0.0), count + there
            middle = total / count
        said = []
        for at, upto in runs(steps):
            said += self.truth(at, middle[np.searchsorted(steps, at) :][: upto - at])
        return said


class _Ring:
    """The newest rows by step: step k stands in slot k modulo the window."""

    def __init__(self, window: int, n: int) -> None:
        self._steps = np.full(window, -1, dtype=np.int64)
        self._rows = np.full((window, n), np.nan)  # touched now: memory that is needed stays the same from here on

    def put(self, steps: NDArray[np.int64], rows: Array) -> None:
        slots = steps % len(self._steps)
        self._steps[slots], self._rows[slots] = steps, rows

    def has(self, steps: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(self._steps[steps % len(self._steps)] == steps)

    def get(self, steps: NDArray[np.int64]) -> Array:
        return self._rows[steps % len(self._steps)]

    def take(self, steps: NDArray[np.int64]) -> Array:
        self._steps[steps % len(self._steps)] = -1
        return self.get(steps)


def log_norms(errors: Array) -> Array:
    """log10 of the 2-norm of every row of (m, n), within FLOOR .. CEILING; NaN for a row with a NaN.

    Scaled by the largest entry: squares of an error beyond 1e154 would overflow, those below 1e-162 vanish.
    """
    if not len(errors):
        return np.zeros(0)
    with np.errstate(invalid="ignore", divide="ignore"):
        largest = np.max(np.abs(errors), axis=1, initial=0.0)
        scale = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
        norms = np.log10(scale) + np.log10(np.linalg.norm(errors / scale[:, None], axis=1))
    return np.asarray(np.clip(norms, FLOOR, CEILING))


def runs(steps: NDArray[np.int64]) -> list[Span]:
    """Ascending steps as spans of consecutive ones."""
    if not len(steps):
        return []
    breaks = np.flatnonzero(np.diff(steps) != 1) + 1
    edges = [0, *breaks.tolist(), len(steps)]
    return [(int(steps[a]), int(steps[b - 1]) + 1) for a, b in pairwise(edges)]


class Decimator:
    """Thins a series to at most two rows per ``stride`` steps: the least and the greatest value, at their own steps.

    Stride 1 or 2 keeps every row. The newest, incomplete stretch of steps is held back until it is complete or drained;
    a batch that comes out of order is thinned for itself.
    """

    def __init__(self, stride: int) -> None:
        self._stride = stride
        self._steps: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._values = np.zeros(0)

    def push(self, steps: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
        """Take rows with ascending steps; the rows to keep of the stretches that are complete."""
        if self._stride <= 2 or not len(steps):
            return steps, values
        steps, values = np.concatenate([self._steps, steps]), np.concatenate([self._values, values])
        open_ = steps // self._stride == steps[-1] // self._stride
        if steps[-1] % self._stride == self._stride - 1:
            open_[:] = False
        self._steps, self._values = steps[open_], values[open_]
        return self._thin(steps[~open_], values[~open_])

    def drain(self) -> tuple[NDArray[np.int64], Array]:
        """The rows to keep of the stretch that was held back."""
        kept = self._thin(self._steps, self._values)
        self._steps, self._values = self._steps[:0], self._values[:0]
        return kept

    def _thin(self, steps: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
        if not len(steps):
            return steps, values
        stretch = steps // self._stride
        order = np.lexsort((values, stretch))  # NaN sorts last: a NaN is kept
        starts = np.flatnonzero(np.diff(stretch[order], prepend=-1))
        ends = np.append(starts[1:], len(order)) - 1
        keep = np.unique(order[np.concatenate([starts, ends])])
        keep = keep[np.argsort(steps[keep], kind="stable")]
        return steps[keep], values[keep]
