"""The life of one sensor process: `python -m duio_mesh.node --spec nodes/node-3.spec`, or started by the launcher.

It holds its own matrices and its neighbours' names, nothing else. Per step k: take y_i(k), u_i(k) from the plant; then,
round by round, send one vector to the neighbours and take exactly the same round's vector from each of them; then keep
the estimate of x(k).
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from math import isfinite
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.faults import NodeFault
from duio_mesh.journal import Journal
from duio_mesh.mesh import Member, Mesh
from duio_mesh.mesh.faulty import LONG_WAY, Arrived, FaultyExchange
from duio_mesh.mesh.lockstep import Exchange, Line, LinkLost, Lockstep
from duio_mesh.mesh.rejoin import HELLO, JOINED, ask, come_back
from duio_mesh.observers import make_observer
from duio_mesh.observers.absence import Late, flagged, neighbours_mean, part_with, start_again, take_late, welcome
from duio_mesh.observers.base import reader
from duio_mesh.observers.watch import watcher
from duio_mesh.process import Report, main
from duio_mesh.spec import PATIENCE, NodeSpec, blocks

NO_VECTOR = np.zeros(0)
BEAT = 0.5  # seconds between signs of life inside a step
RETURN = 1.0  # seconds in which a neighbour answers a process that comes back, unless it is gone itself


def run(spec: NodeSpec, report: Report) -> None:
    """Run one node for ``spec.steps`` steps. Raises RunError when a neighbour or the plant is lost or late."""
    with Mesh(spec.wire, f"node-{spec.id}", report.warn, spec.incarnation) as mesh:
        links = Links(spec, mesh, report)
        mesh.watch(links.lockstep.noticed)
        with links.lockstep:
            first = rejoin(spec, links, report) if spec.incarnation else 0
            if not spec.incarnation:
                mesh.meet()
                report("ready")
            row = sum(part.size for part in links.observer.estimate())
            with Journal(spec.output, row, links.trace, first) as journal:
                figures = live(spec, first, links, journal, report)
    report("done", **figures, frames=links.told.frames, rejected=mesh.rejections(), faults=links.faults())


class Links:
    """The observer, and everything that its node hears and tells."""

    def __init__(self, spec: NodeSpec, mesh: Mesh, report: Report) -> None:
        i, keys, window = spec.id, mesh.keys, spec.window
        room = LONG_WAY if spec.without else 0
        self.observer = make_observer(spec)
        self.mesh, self._spec, self._report = mesh, spec, report
        self.lockstep = Lockstep(mesh, spec.deadline * (1 if spec.on_loss == "stop" else PATIENCE), report)
        self.plant = Line(mesh, keys.plant(i), f"plant -> {i}", "plant", ("plant", i), window)
        self.heard = {
            j: Line(mesh, keys.edge(j, i), f"edge {j} -> {i}", f"node-{j}", (j, i), window, room) for j in spec.hears
        }
        self.told = mesh.speak([(keys.edge(i, j), f"edge {i} -> {j}", (i, j)) for j in spec.tells])
        self.credit = mesh.speak([(keys.credit(i), f"{i} -> plant", (i, "plant"))])
        self.trace = mesh.speak([(keys.trace(i), f"{i} -> recorder", None)], drop=True)
        self.exchange: Exchange | FaultyExchange = Exchange(self.lockstep, self.told, self.heard)
        if spec.without:  # messages can be missing
            self.exchange = FaultyExchange(spec, self.lockstep, self.told, self.heard, self)
        self.back: dict[int, int] = {}  # nodes that come back at this step, and how many processes of each there were

    def faults(self) -> dict[str, int]:
        """How many frames met which fault."""
        return dict(self.exchange.counts) if isinstance(self.exchange, FaultyExchange) else {}

    def late(self, k: int, arrived: Sequence[Arrived]) -> None:
        """Give the observer the older frames that arrive in step k."""
        take_late(self.observer, [Late(stamp.source, k - stamp.k, stamp.r, vector) for stamp, vector in arrived])

    def lost(self, j: int, k: int, r: int, why: str) -> None:
        """Go on without neighbour j."""
        part_with(self.observer, j)
        if why:
            self._report("lost", node=j, k=k, r=r, text=why)

    def samples(self, first: int) -> Iterator[Array]:
        """[y_i(k); u_i(k)] for k = first, first + 1, ...: the plant sends a few steps in one frame."""
        spec, size = self._spec, self._spec.p + self._spec.m
        for block in blocks(first, spec.steps, spec.block, spec.breaks):
            k, count = block.start, len(block)
            rows = self.lockstep.take(self.plant, k, 0, count * size).reshape(count, size)
            joined = self.plant.waiting.pop((k, JOINED), None)
            self.back = {} if joined is None else come_back(joined)
            yield from rows

    def take_back(self, k: int) -> None:
        """Go on with the neighbours that come back at step k; tell them where we are."""
        spec, back, self.back = self._spec, self.back, {}
        for j, before in back.items():
            near = j != spec.id and (j in spec.hears or j in spec.tells)
            if not near or not self.mesh.await_birth(Member(f"node-{j}", before), RETURN):
                continue  # gone again already: it stays lost
            if j in spec.tells and spec.warm and k:
                self.told.send_to(spec.tells.index(j), k, HELLO, self.observer.estimate().state)
            if j in spec.hears and isinstance(self.exchange, FaultyExchange):
                self.heard[j].expect(before)
                self.exchange.welcome(j)
                welcome(self.observer, j)
                self._report("joined", node=j, k=k)


def rejoin(spec: NodeSpec, links: Links, report: Report) -> int:
    """Take the place of a lost process (mesh/rejoin.py); the step to begin with. Raises RunError like ``run``."""
    mesh, exchange = links.mesh, links.exchange
    assert isinstance(exchange, FaultyExchange)  # noqa: S101  (spec.on_loss is restart)
    mesh.unanswered(RETURN)  # who does not answer is gone itself
    report("ready")
    k, data, joined, away = ask(links.lockstep, links.plant, links.credit, spec.incarnation)
    links.lockstep.first = k
    links.observer = make_observer(replace(spec, steps=spec.steps - k))
    told = []
    for j, line in links.heard.items():
        if not exchange.expects(j, k):
            continue  # not there, as planned
        try:
            there = None
            if j in joined:
                there = Member(line.who, joined[j]) if mesh.await_birth(Member(line.who, joined[j]), RETURN) else None
            elif j not in away:
                there = mesh.await_somebody(line.who, RETURN)
            if there is None:
                raise LinkLost(f"{line.who} was gone when node-{spec.id} came back")
            line.expect(there.before)
            if spec.warm and data.size and j not in joined:  # who comes back, too, knows no more than we do
                told.append(links.lockstep.take(line, k, HELLO, spec.n))
        except LinkLost as e:
            exchange.lose(j, k, 0, str(e))
    start_again(links.observer, neighbours_mean(told), data, spec.p)
    report("back", k=k, told_by=len(told))
    return k


def live(spec: NodeSpec, first: int, links: Links, journal: Journal, report: Report) -> dict[str, Any]:
    """The steps of a node from ``first`` on, and what they came to."""
    p, observer, exchange, zeros = spec.p, links.observer, links.exchange, np.zeros(spec.n)
    estimates, watched = reader(observer), watcher(observer)
    acts = {act.step: act for act in spec.acts if act.step > first or not spec.incarnation}
    samples = links.samples(first)
    if first not in acts:
        samples = chain((next(samples),), samples)  # the first may take its time: the others are still starting
    begin, cpu = time.monotonic(), time.process_time()
    rounds, doubtful, promised, beat = 0, 0, first + spec.credit, begin + BEAT
    for k in range(first, spec.steps, spec.batch):
        if k in acts:
            act_on_purpose(acts[k], links, journal, report)
        done = min(k + spec.batch, spec.steps)
        for _ in range(k, done):
            sample = next(samples)
            if links.back:
                links.take_back(k)
            observer.sample(sample[:p], sample[p:])
        for r in range(observer.rounds):
            observer.exchange(r, exchange(k, r, observer.message(r)))
            rounds += 1
            if (now := time.monotonic()) > beat:  # a step of many rounds may last longer than any deadline
                beat = now + BEAT
                links.credit.send(k, 0, NO_VECTOR)
                report.beat()
        if len(figures := watched()):
            journal.aside(spec.options["watch_step"], figures)
        doubtful += flagged(observer) * (done - k)  # estimates that the observer marks
        for estimate in estimates():
            if not isfinite(zeros.dot(estimate.state)):
                raise RunError(f"node-{spec.id}: the estimate overflowed at step {k}; is the plant unstable?")
            journal.add(estimate)
        if done >= promised or done == spec.steps:
            promised = done + spec.credit
            links.credit.send(done, 0, NO_VECTOR)
    seconds, cpu_seconds = time.monotonic() - begin, time.process_time() - cpu
    return {"steps": spec.steps, "rounds": rounds, "seconds": seconds, "cpu_seconds": cpu_seconds, "flagged": doubtful}


def act_on_purpose(act: NodeFault, links: Links, journal: Journal, report: Report) -> None:
    """Stop or kill this very process at the beginning of a step; whatever it has said before has arrived then."""
    journal.flush()
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
