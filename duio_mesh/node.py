"""The life of one sensor process: `python -m duio_mesh.node --spec nodes/node-3.spec`, or started by the launcher.

It holds its own matrices and its neighbours' names, nothing else. Per step k: take y_i(k), u_i(k) from the plant; then,
round by round, send one vector to the neighbours and take exactly the same round's vector from each of them; then keep
the estimate of x(k).
"""

from __future__ import annotations

import os
import signal
import time
from itertools import chain, islice
from math import isfinite
from typing import Any

import numpy as np

from duio_mesh.errors import RunError
from duio_mesh.faults import NodeFault
from duio_mesh.journal import Journal
from duio_mesh.links import Links
from duio_mesh.mesh import Mesh
from duio_mesh.observers.base import reader
from duio_mesh.observers.watch import watcher
from duio_mesh.process import Report, main
from duio_mesh.spec import NodeSpec
from duio_mesh.tape import Tape

NO_VECTOR = np.zeros(0)
BEATS = 5  # signs of life inside a step per deadline


def run(spec: NodeSpec, report: Report) -> None:
    """Run one node for ``spec.steps`` steps. Raises RunError when a neighbour or the plant is lost or late."""
    with Tape(spec) as tape, Mesh(spec.wire, f"node-{spec.id}", report.warn, spec.incarnation) as mesh:
        report.last = lambda: {"rejected": mesh.rejections()}
        links = Links(spec, mesh, tape, report)
        mesh.watch(links.lockstep.noticed)
        with links.gaps, links.lockstep:
            first = links.rejoin() if spec.incarnation else links.begin()
            row = sum(part.size for part in links.observer.estimate())
            with Journal(spec.output, row, links.trace, first) as journal:
                figures = live(spec, first, links, journal, report)
    counts = {"frames": links.told.frames, "rejected": mesh.rejections(), "faults": links.faults()}
    report("done", **figures, **counts, timing=links.timing())


def live(spec: NodeSpec, first: int, links: Links, journal: Journal, report: Report) -> dict[str, Any]:
    """The steps of a node from ``first`` on, and what they came to."""
    p, observer, exchange, zeros = spec.p, links.observer, links.exchange, np.zeros(spec.n)
    estimates, watched = reader(observer), watcher(observer)
    acts = {act.step: act for act in spec.acts if act.step > first or not spec.incarnation}
    samples = links.samples(first)
    if first not in acts:
        samples = chain((next(samples),), samples)  # the first may take its time: the others are still starting
    begun, cpu, pause = time.monotonic(), time.process_time(), spec.deadline / BEATS
    rounds, promised, beat, steps = 0, first + spec.credit, begun + pause, spec.steps
    for k in range(first, spec.steps, spec.batch):
        if k in acts:
            act_on_purpose(acts[k], links, journal, report)
        done = min(k + spec.batch, spec.steps)
        block = list(islice(samples, done - k))
        if links.back:
            links.take_back(k)
        for sample in block:
            observer.sample(sample[:p], sample[p:])
        if not block:  # the sensors are done before we are
            links.credit.send(steps := k, 0, NO_VECTOR)
            break
        for r in range(observer.rounds):
            observer.exchange(r, exchange(k, r, observer.message(r)))
            rounds += 1
            if (now := time.monotonic()) > beat:  # a step of many rounds may last longer than any deadline
                beat = now + pause
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
    seconds, cpu_seconds = time.monotonic() - begun, time.process_time() - cpu
    return {"steps": steps, "rounds": rounds, "seconds": seconds, "cpu_seconds": cpu_seconds}


def act_on_purpose(act: NodeFault, links: Links, journal: Journal, report: Report) -> None:
    """Stop or kill this very process at the beginning of a step; whatever it has said before has arrived then."""
    journal.flush()
    links.tape.flush()
    if act.what == "pause":
        report("pausing", k=act.step, seconds=act.seconds)
        os.kill(os.getpid(), signal.SIGSTOP)
        report("resumed", k=act.step)
        return
    report("dying", k=act.step)
    links.mesh.close()
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    main(NodeSpec, run)
