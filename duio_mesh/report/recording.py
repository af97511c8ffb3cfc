"""A run as a Rerun recording: live while it runs, complete when it has ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.report import blueprint as look
from duio_mesh.report.buffer import ROWS, Buffer
from duio_mesh.report.conditions import Conditions
from duio_mesh.report.entities import EVENTS, WATCHED, Column, Entities
from duio_mesh.report.flags import Flags
from duio_mesh.report.gaps import Gaps
from duio_mesh.report.pairing import Decimator, Errors, Middle, Pairing, Span, Spans, log_norms, runs
from duio_mesh.report.streams import Batch, FileStream, LiveStream, Opening
from duio_mesh.report.worst import Worst
from duio_mesh.spec import RecorderSpec

SENDS = 10  # of one series in a whole run: each leaves some kB with Rerun until the file is closed ...
LIVE_SENDS = 100  # ... where somebody may watch: a viewer is behind by one percent of the plot's width at most
RATES = 16  # of one process that are sent at once where nobody watches
CHUNKS = 8_000  # sends of a whole run, all series: each costs 50 microseconds and 2 kB whatever is in it


class Recording:
    """recording.rrd and, where the spec says so, the same live.

    Rows may arrive in any order, in batches of any size, twice, or never; ``missing`` says what never came and ``fill``
    takes it from elsewhere. Nothing here waits for a viewer. Not for several threads.
    """

    def __init__(self, spec: RecorderSpec, *, rates: bool = True) -> None:
        """Open the file (and the live server). ``rates``: whether there will be any.

        Raises OSError when the file cannot be created or no port be had, ValueError when Rerun is turned off.
        """
        self._spec, self._entities = spec, Entities(spec)
        entities = self._entities
        description = f"{spec.description}\n\n---\n{entities.kept()}\n"
        layout = look.blueprint(entities, rates=rates)
        opening = Opening.of(spec.name, spec.step, layout, look.styles(entities, description))
        self._file = FileStream(Path(spec.recording), opening)
        self._live = LiveStream(opening) if spec.live else None
        self._closed, self._watched = False, set[int]()
        self._worst = Worst(entities.ids, spec.steps)
        self._has_rates = rates
        self._rates = dict[str, Buffer]()

        self._middle = Middle(spec.n, entities.ids, spec.steps) if spec.outside else None
        self._pairing = self._middle or Pairing(spec.n, entities.ids, spec.steps)
        self._seen: dict[int | None, Spans] = {source: Spans() for source in (None, *entities.ids)}
        self._thinned = {i: Decimator(entities.error_stride) for i in entities.ids}
        self._columns: dict[int | None, tuple[Column, ...]] = {None: entities.truth}
        self._columns |= {i: entities.estimates(i) for i in entities.ids}
        paths = {source: [path for _, path in columns] for source, columns in self._columns.items()}
        most = LIVE_SENDS if spec.live else SENDS
        enough = _enough(entities.error_rows, len(entities.ids), CHUNKS // 4, most)
        self._errors = {i: Buffer([entities.error(i)], enough, self._scalars) for i in entities.ids}
        enough = _enough(entities.state_values, entities.series, CHUNKS * 3 // 4, most)
        self._states = {source: Buffer(paths[source], enough, self._scalars) for source in paths}

        self.event(f"{len(entities.ids)} nodes, {spec.n} states, {spec.steps} steps of {spec.step:g} s")
        self._conditions = Conditions(entities, self._send, self.event, self._given)
        self._gaps = Gaps(entities, self._scalars) if spec.tick else None
        self._flags = Flags(entities, self._send) if spec.flags else None

    @property
    def url(self) -> str | None:
        """Where a viewer can watch (``rerun URL``), or None when the recording is not live."""
        return self._live.url if self._live else None

    @property
    def dropped(self) -> int:
        """Batches that the live server could not take because a viewer was too slow; the file has them."""
        return self._live.dropped if self._live else 0

    def truth(self, k: int, rows: Array) -> None:
        """True states (m, n) of the steps k .. k+m-1. Raises ValueError for a wrong shape or step."""
        self._check("the truth", k, rows, self._spec.n)
        self._record(None, k, rows)
        for errors in self._pairing.truth(k, rows):
            self._say(errors)

    def estimates(self, node: int, k: int, rows: Array) -> None:
        """Rows (m, size) of a node for the steps k .. k+m-1: n states, then what else the method estimates,
        and where the spec says so its own mark of the estimate (not 0: flagged).

        Raises ValueError for a wrong shape or step, KeyError for an unknown node.
        """
        self._check(f"node {node}", k, rows, self._spec.sizes[node])
        self._record(node, k, rows)
        for first, last in self._pairing.known[node].gaps(k, k + len(rows)):
            part = rows[first - k : last - k, : self._spec.n]
            for errors in self._middle.together(node, first, part) if self._middle else ():
                self._say(errors)
            if not self._middle:
                self._say(self._pairing.estimates(node, first, part))

    def rounds(self, node: int, rows: Array) -> None:
        """Rows (m, 3) [round, residual, disagreement] of the step ``spec.watch_step``; a node's first ones count.

        Raises ValueError for another shape.
        """
        if rows.ndim != 2 or rows.shape[1] != 1 + len(WATCHED):
            raise ValueError(f"node {node}: rounds of shape {rows.shape} instead of (m, {1 + len(WATCHED)})")
        k = self._spec.watch_step
        if k is None or node in self._watched or not len(rows):
            return
        self._watched.add(node)
        steps, r = np.full(len(rows), k), rows[:, 0].astype(np.int64)
        for at, kind in enumerate(WATCHED, start=1):
            columns = rr.Scalars.columns(scalars=log_norms(rows[:, at : at + 1]))
            self._send(self._entities.rounds(kind, node), steps, columns, r)

    def liveness(self, who: str | int, state: str, k: int) -> None:
        """How a process (plant, node-3 or the node's id) is from step k on: up, late or down.

        A process that goes is not called down before its rows have stopped coming (they may be on their way still),
        and never when its last step is here: then it has done its work. Repeating a state is no news.
        """
        self._conditions.process(who if isinstance(who, str) else f"node-{who}", state, k)

    def edge(self, i: int, j: int, state: str, k: int) -> None:
        """How the arc on which i tells j is from step k on: up, late or down. Raises KeyError when there is none."""
        self._conditions.arc(i, j, state, k)

    def event(self, text: str, level: str = "INFO", k: int = 0) -> None:
        """A line of the event log; ``level`` is one of TRACE, DEBUG, INFO, WARN, ERROR."""
        self._send(EVENTS, [k], rr.TextLog.columns(text=[text], level=[level]))

    def rates(self, k: int, values: Mapping[str, float]) -> None:
        """Steps per second of processes (plant, node-3) at step k; about once a second is enough."""
        for who, value in values.items():
            if who not in self._rates:
                together = 1 if self._spec.live else RATES
                self._rates[who] = Buffer([self._entities.rate(who)], together, self._scalars)
            self._rates[who].add(np.array([k]), np.array([[float(value)]]))

    def missing_neighbours(self, node: int, k: int, counts: Array) -> None:
        """How many neighbours a node went on without in the steps from k on (m,), in a run on the wall clock."""
        if self._gaps:
            self._gaps.rows(node, k, counts)

    def flush(self) -> None:
        """Write what has gathered, where it is enough to be worth it. Call it as often as a viewer should see news.

        What is written survives a kill. Raises OSError when the disk would not take it.
        """
        self._conditions.settle()
        for buffer in self._buffers():
            buffer.flush()
        self._file.flush()

    def missing(self, steps: int | None = None) -> dict[int | None, list[Span]]:
        """Steps (first, last + 1) whose rows or errors are not in the recording, by node; None is the truth.

        Of the first ``steps`` steps, by default of all. A truth that nobody knows is not missing.
        """
        steps = self._spec.steps if steps is None else steps
        found = {None: self._seen[None].gaps(0, steps)} | {i: s.gaps(0, steps) for i, s in self._pairing.known.items()}
        if self._spec.outside:
            del found[None]
        return {source: gaps for source, gaps in found.items() if gaps}

    def fill(self, truth: Array, estimates: Mapping[int, Array]) -> None:
        """Take what is missing from whole files: row k of each is step k. They may be short, or memory maps.

        Rows whose states are all NaN were never written by anybody and stay missing.
        """
        window = self._pairing.window
        wanted = {i: spans for i, spans in self.missing().items() if i is None or i in estimates}
        for first, last in runs(_union(wanted.values(), window)):
            for k in range(first * window, min(last * window, self._spec.steps), window):
                self._give(None, k, truth[k : k + window])
                for i, rows in estimates.items():
                    self._give(i, k, rows[k : k + window])
                for errors in self._middle.rest(k, min(k + window, self._spec.steps)) if self._middle else ():
                    self._say(errors)

    def close(self) -> None:
        """Mark what is still missing, write everything and the footer. Raises OSError when the disk would not take it.

        A viewer that is frozen is left behind after two seconds.
        """
        if self._closed:
            return
        self._closed = True
        self._conditions.settle(final=True)
        for i, decimator in self._thinned.items():
            self._errors[i].add(*_column(*decimator.drain()))
        steps = self._spec.steps
        if self._spec.outside:  # who feeds the run may end it early
            steps = max(self._reached(f"node-{i}") for i in self._entities.ids)
        missing = self.missing(steps)
        if not missing:
            self.event("complete: every step of every node is here", "INFO", max(0, steps - 1))
        for source, gaps in missing.items():
            who = "the truth" if source is None else f"node {source}"
            spans = ", ".join(f"{a} to {b - 1}" for a, b in gaps[:8]) + (", ..." if len(gaps) > 8 else "")
            self.event(f"not in the recording: {who}, steps {spans}", "WARN", gaps[-1][1] - 1)
        self._break_lines()
        if self.dropped:
            self.event(f"{self.dropped} batches were too much for a live viewer; this file has them", "INFO")
        for buffer in self._buffers():
            buffer.flush(everything=True)
        if len(self._entities.ids) > look.LINES:
            worst = self._worst.nodes(look.LINES)
            self._file.lay_out(look.blueprint(self._entities, rates=self._has_rates, worst=worst))
        try:
            self._file.close()
        finally:
            if self._live:
                self._live.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _check(self, who: str, k: int, rows: Array, size: int) -> None:
        if rows.ndim != 2 or rows.shape[1] != size:
            raise ValueError(f"{who}: rows of shape {rows.shape} instead of (m, {size})")
        if k < 0 or k + len(rows) > self._spec.steps:
            raise ValueError(f"{who}: steps {k} to {k + len(rows) - 1} of a run of {self._spec.steps}")

    def _record(self, source: int | None, k: int, rows: Array) -> None:
        """Keep the rows that are new."""
        columns, stride, final = self._columns[source], self._entities.state_stride, self._spec.steps - 1
        for first, last in self._seen[source].gaps(k, k + len(rows)):
            steps = np.arange(first, last)
            keep = (steps % stride == 0) | (steps == final)
            new = rows[first - k : last - k]
            self._states[source].add(steps[keep], new[keep][:, [c for c, _ in columns]])
            if self._flags and source is not None:
                self._flags.rows(source, first, new[:, -1])
        self._seen[source].add(k, k + len(rows))

    def _say(self, errors: Errors) -> None:
        self._worst.see(errors)
        steps, values = self._thinned[errors.node].push(errors.steps, errors.log10)
        self._errors[errors.node].add(*_column(steps, values))

    def _reached(self, who: str) -> int:
        """The step after the last that a process has given."""
        return max((last for _, last in self._given(who)), default=0)

    def _given(self, who: str) -> Spans:
        """The steps of which a process has given rows."""
        return self._seen[None if who == "plant" else int(who.removeprefix("node-"))]

    def _break_lines(self) -> None:
        """A NaN at the start of every gap between two rows: a viewer would join the rows with a line. Lanes end too."""
        if self._flags:
            for i in self._entities.ids:
                self._flags.gaps(i, [first for first, _ in self._seen[i].gaps(0, self._spec.steps)])
        for i, known in self._pairing.known.items():
            at = _inner_gaps(known)
            self._errors[i].add(at, np.full((len(at), 1), np.nan))
        for source, seen in self._seen.items():
            at = _inner_gaps(seen)
            self._states[source].add(at, np.full((len(at), len(self._columns[source])), np.nan))

    def _give(self, source: int | None, k: int, rows: Array) -> None:
        """Take the rows that somebody wrote."""
        for first, last in runs(np.flatnonzero(~np.isnan(rows[:, : self._spec.n]).all(axis=1))):
            part = np.asarray(rows[first:last])
            if source is None:
                self.truth(k + first, part)
            else:
                self.estimates(source, k + first, part)

    def _buffers(self) -> list[Buffer]:
        said = (*self._errors.values(), *self._states.values(), *self._rates.values())
        return [*said, *(self._gaps.buffers.values() if self._gaps else ())]

    def _scalars(self, path: str, steps: NDArray[np.int64], values: Array) -> None:
        self._send(path, steps, rr.Scalars.columns(scalars=values))

    def _send(
        self,
        path: str,
        steps: Sequence[int] | NDArray[np.int64],
        columns: Any,
        rounds: NDArray[np.int64] | None = None,
    ) -> None:
        batch = Batch(path, np.asarray(steps, dtype=np.int64), columns, rounds)
        self._file.send(batch)
        if self._live:
            self._live.send(batch)


def _enough(values: int, series: int, sends: int, most: int) -> int:
    """Rows that one send of a series should hold: all are to take so many sends, one of them ``most``."""
    return min(ROWS, max(1, values // series // max(1, min(most, sends // series))))


def _column(steps: NDArray[np.int64], values: Array) -> tuple[NDArray[np.int64], Array]:
    return steps, values[:, None]


def _inner_gaps(spans: Spans) -> NDArray[np.int64]:
    """The first step of every gap between two spans."""
    return np.array([last for _, last in spans][:-1], dtype=np.int64)


def _union(many: Any, window: int) -> NDArray[np.int64]:
    """Ascending numbers of the stretches of ``window`` steps that these spans touch."""
    touched = {at for spans in many for first, last in spans for at in range(first // window, (last - 1) // window + 1)}
    return np.array(sorted(touched), dtype=np.int64)
