"""The life of one sensor process: `python -m duio_mesh.node --spec nodes/node-3.spec`, or started by the launcher.

It holds its own matrices and its neighbours' names, nothing else. Per step k: take y_i(k), u_i(k) from the plant; then,
round by round, send one vector to the neighbours and take exactly the same round's vector from each of them; then keep
the estimate of x(k).
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from functools import partial
from math import isfinite

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.journal import Journal
from duio_mesh.mesh import Mesh
from duio_mesh.mesh.faulty import LONG_WAY, Arrived, FaultyExchange
from duio_mesh.mesh.lockstep import Exchange, Line, Lockstep
from duio_mesh.observers import Observer, make_observer
from duio_mesh.observers.absence import Late, flagged, take_late
from duio_mesh.observers.base import reader
from duio_mesh.observers.watch import watcher
from duio_mesh.process import Report, main
from duio_mesh.spec import NodeSpec

NO_VECTOR = np.zeros(0)
BEAT = 0.5  # seconds between signs of life inside a step


def _samples(lockstep: Lockstep, plant: Line, spec: NodeSpec) -> Iterator[Array]:
    """[y_i(k); u_i(k)] for k = 0, 1, ...: the plant sends a few steps in one frame."""
    size = spec.p + spec.m
    for k in range(0, spec.steps, spec.block):
        count = min(spec.block, spec.steps - k)
        yield from lockstep.take(plant, k, 0, count * size).reshape(count, size)


def _hand_over(observer: Observer, k: int, arrived: Sequence[Arrived]) -> None:
    """Give the observer the older frames that arrive in step k."""
    take_late(observer, [Late(stamp.source, k - stamp.k, stamp.r, vector) for stamp, vector in arrived])


def run(spec: NodeSpec, report: Report) -> None:
    """Run one node for ``spec.steps`` steps. Raises RunError when a neighbour or the plant is lost or late."""
    i, p, window = spec.id, spec.p, spec.window
    observer = make_observer(spec)
    with Mesh(spec.wire, f"node-{i}", report.warn) as mesh:
        keys = mesh.keys
        plant = Line(mesh, keys.plant(i), f"plant -> {i}", "plant", ("plant", i), window)
        room = LONG_WAY if spec.without else 0
        heard = {
            j: Line(mesh, keys.edge(j, i), f"edge {j} -> {i}", f"node-{j}", (j, i), window, room) for j in spec.hears
        }
        told = mesh.speak([(keys.edge(i, j), f"edge {i} -> {j}", (i, j)) for j in spec.tells])
        credit = mesh.speak([(keys.credit(i), f"{i} -> plant", (i, "plant"))])
        trace = mesh.speak([(keys.trace(i), f"{i} -> recorder", None)], drop=True)
        lockstep = Lockstep(mesh, spec.deadline)
        exchange: Exchange | FaultyExchange = Exchange(lockstep, told, heard)
        if spec.without:  # faults are made on purpose
            exchange = FaultyExchange(spec, lockstep, told, heard, partial(_hand_over, observer))
        mesh.watch(lockstep.noticed)
        mesh.meet()
        report("ready")
        row = sum(part.size for part in observer.estimate())
        zeros = np.zeros(spec.n)
        estimates, samples = reader(observer), _samples(lockstep, plant, spec)
        watched = watcher(observer)
        doubtful = 0  # estimates that the observer marks
        rounds, promised, begin, cpu = 0, spec.credit, time.monotonic(), time.process_time()
        beat = begin + BEAT
        with lockstep, Journal(spec.output, row, trace) as journal:
            for k in range(0, spec.steps, spec.batch):
                done = min(k + spec.batch, spec.steps)
                for _ in range(k, done):
                    sample = next(samples)
                    observer.sample(sample[:p], sample[p:])
                for r in range(observer.rounds):
                    observer.exchange(r, exchange(k, r, observer.message(r)))
                    rounds += 1
                    if (now := time.monotonic()) > beat:  # a step of many rounds may last longer than any deadline
                        beat = now + BEAT
                        credit.send(k, 0, NO_VECTOR)
                        report.beat()
                if len(figures := watched()):
                    journal.aside(spec.options["watch_step"], figures)
                doubtful += flagged(observer) * (done - k)
                for estimate in estimates():
                    if not isfinite(zeros.dot(estimate.state)):
                        raise RunError(f"node-{i}: the estimate overflowed at step {k}; is the plant unstable?")
                    journal.add(estimate)
                if done >= promised or done == spec.steps:
                    promised = done + spec.credit
                    credit.send(done, 0, NO_VECTOR)
        report(
            "done",
            steps=spec.steps,
            rounds=rounds,
            seconds=time.monotonic() - begin,
            cpu_seconds=time.process_time() - cpu,
            frames=told.frames,
            rejected=mesh.rejections(),
            flagged=doubtful,
            faults=dict(exchange.counts) if isinstance(exchange, FaultyExchange) else {},
        )


if __name__ == "__main__":
    main(NodeSpec, run)
