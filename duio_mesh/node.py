"""The life of one sensor process: `python -m duio_mesh.node --spec nodes/node-3.spec`, or started by the launcher.

It holds its own matrices and its neighbours' names, nothing else. Per step k: take y_i(k), u_i(k) from the plant; then,
round by round, send one vector to the neighbours and take exactly the same round's vector from each of them; then keep
the estimate of x(k).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from itertools import chain, islice
from math import isfinite
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.journal import MISSING, Journal, missing
from duio_mesh.mesh import Mesh
from duio_mesh.mesh.faulty import LONG_WAY, Arrived, FaultyExchange
from duio_mesh.mesh.lockstep import Ended, Exchange, Line, Lockstep
from duio_mesh.mesh.realtime import Realtime
from duio_mesh.mesh.session import Ready
from duio_mesh.observers import Observer, make_observer
from duio_mesh.observers.absence import Late, take_late
from duio_mesh.observers.base import reader
from duio_mesh.observers.watch import watcher
from duio_mesh.process import Report, main
from duio_mesh.spec import NodeSpec
from duio_mesh.tape import Tape

NO_VECTOR = np.zeros(0)
BEAT = 0.5  # seconds between signs of life inside a step


def run(spec: NodeSpec, report: Report) -> None:
    """Run one node for ``spec.steps`` steps. Raises RunError when a neighbour or the plant is lost or late."""
    with Tape(spec) as tape, Mesh(spec.wire, f"node-{spec.id}", report.warn) as mesh:
        observer = tape.follow(make_observer(spec))
        row = sum(part.size for part in observer.estimate())
        links = Links(spec, mesh, observer)
        mesh.watch(links.lockstep.noticed)
        mesh.meet()
        report("ready")
        with links.gaps, links.lockstep, Journal(spec.output, row, links.trace) as journal:
            figures = live(spec, observer, links, journal, report)
    counts = {"frames": links.told.frames, "rejected": mesh.rejections(), "faults": links.faults()}
    report("done", **figures, **counts, timing=links.timing())


class Links:
    """Everything that one node hears and tells."""

    def __init__(self, spec: NodeSpec, mesh: Mesh, observer: Observer) -> None:
        i, keys, window = spec.id, mesh.keys, spec.window
        room = LONG_WAY if spec.without else 0
        edges: list[tuple[str, str, Ready | None]] = [(keys.edge(i, j), f"edge {i} -> {j}", (i, j)) for j in spec.tells]
        self.told = mesh.speak(edges, drop=spec.tick > 0)  # in real time nobody waits for who does not listen
        self.credit = mesh.speak([(keys.credit(i), f"{i} -> plant", (i, "plant"))])
        self.trace = mesh.speak(
            [(keys.trace(i), f"{i} -> recorder", (i, "recorder") if spec.kept else None)], drop=not spec.kept
        )
        self.exchange: Exchange | FaultyExchange | Realtime
        self.lockstep: Lockstep | Realtime
        self.gaps: AbstractContextManager[object] = nullcontext()
        late = partial(_hand_over, observer)
        if spec.tick:
            self.gaps = gaps = Journal(str(missing(spec.output)) if spec.output else "", 1, self.trace, MISSING)
            self.lockstep = self.exchange = clock = Realtime(spec, mesh, self.told, late, gaps.add)
            self.sample: Callable[[int, int, int], Array] = clock.sample
            return
        self.lockstep = lockstep = Lockstep(mesh, spec.deadline)
        plant = Line(mesh, keys.plant(i), f"plant -> {i}", "plant", ("plant", i), window)
        plant.patient = spec.outside
        self.sample = partial(lockstep.take, plant)
        heard = {
            j: Line(mesh, keys.edge(j, i), f"edge {j} -> {i}", f"node-{j}", (j, i), window, room) for j in spec.hears
        }
        self.exchange = Exchange(lockstep, self.told, heard)
        if spec.without:  # faults are made on purpose
            self.exchange = FaultyExchange(spec, lockstep, self.told, heard, late)

    def faults(self) -> dict[str, int]:
        """How many frames met which fault."""
        return {} if isinstance(self.exchange, Exchange) else dict(self.exchange.counts)

    def timing(self) -> dict[str, int]:
        """In real time: how many messages were in time, late and missing, and how many steps took too long."""
        return self.exchange.timing() if isinstance(self.exchange, Realtime) else {}


def live(spec: NodeSpec, observer: Observer, links: Links, journal: Journal, report: Report) -> dict[str, Any]:
    """The steps of a node, and what they came to."""
    p, exchange, zeros = spec.p, links.exchange, np.zeros(spec.n)
    estimates, watched = reader(observer), watcher(observer)
    samples = _samples(links, spec)
    samples = chain((next(samples),), samples)  # the first may take its time: the others are still starting
    begin, cpu = time.monotonic(), time.process_time()
    rounds, promised, beat, steps = 0, spec.credit, begin + BEAT, spec.steps
    for k in range(0, spec.steps, spec.batch):
        done = min(k + spec.batch, spec.steps)
        for sample in (block := list(islice(samples, done - k))):
            observer.sample(sample[:p], sample[p:])
        if not block:  # the sensors are done before we are
            links.credit.send(steps := k, 0, NO_VECTOR)
            break
        for r in range(observer.rounds):
            observer.exchange(r, exchange(k, r, observer.message(r)))
            rounds += 1
            if (now := time.monotonic()) > beat:  # a step of many rounds may last longer than any deadline
                beat = now + BEAT
                links.credit.send(k, 0, NO_VECTOR)
                report.beat()
        if len(figures := watched()):
            journal.aside(spec.options["watch_step"], figures)
        for estimate in estimates():
            if not isfinite(zeros.dot(estimate.state)):
                raise RunError(f"node-{spec.id}: the estimate overflowed at step {k}; is the plant unstable?")
            journal.add(estimate)
        if done >= promised or done == spec.steps:
            promised = done + spec.credit
            links.credit.send(done, 0, NO_VECTOR)
    seconds, cpu_seconds = time.monotonic() - begin, time.process_time() - cpu
    return {"steps": steps, "rounds": rounds, "seconds": seconds, "cpu_seconds": cpu_seconds}


def _samples(links: Links, spec: NodeSpec) -> Iterator[Array]:
    """[y_i(k); u_i(k)] for k = 0, 1, ...: the plant sends a few steps in one frame."""
    size = spec.p + spec.m
    for k in range(0, spec.steps, spec.block):
        count = min(spec.block, spec.steps - k)
        try:
            yield from links.sample(k, 0, count * size).reshape(count, size)
        except Ended:
            return


def _hand_over(observer: Observer, k: int, arrived: Sequence[Arrived]) -> None:
    """Give the observer the older frames that arrive in step k."""
    take_late(observer, [Late(stamp.source, k - stamp.k, stamp.r, vector) for stamp, vector in arrived])


if __name__ == "__main__":
    main(NodeSpec, run)
