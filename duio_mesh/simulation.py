"""The oracle: the same plant and observers in one process, without Zenoh. The mesh must equal it bit for bit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.dynamics import Plant
from duio_mesh.errors import RunError
from duio_mesh.faults import Reception, Stamp
from duio_mesh.observers import make_observer
from duio_mesh.observers.absence import Late, greeting, part_with, start_again, take_late, welcome
from duio_mesh.observers.base import NOTHING, reader
from duio_mesh.observers.watch import watcher
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.design import Design
from duio_mesh.trace import Trace as Trace  # re-exported: it lives lower, where report/ may import it


@dataclass
class Tally:
    """What processes would have counted."""

    rounds: int = 0  # exchanges of the node that has most of them
    messages: int = 0  # frames between nodes
    faults: Counter[str] = field(default_factory=Counter)  # frames by what the fault model did to them


def simulate(design: Design, progress: Callable[[int], None] = lambda _: None, tally: Tally | None = None) -> Trace:
    """Run plant and observers in lockstep; ``progress`` is called with the number of finished steps.

    ``tally`` is filled in.

    Raises RunError at a step in which a node is killed on purpose and ``run.on_node_loss`` is stop.
    """
    tally = Tally() if tally is None else tally
    plant = Plant(design.plant)
    nodes = {i: _Node(spec) for i, spec in design.nodes.items()}
    truth = list[Array]()
    steps, batch = design.plant.steps, design.scenario.run.batch
    data = before = dict[int, Array]()
    for k in range(0, steps, batch):
        done = min(k + batch, steps)
        _come_and_go(design, nodes, k, before)
        present = {i: node for i, node in nodes.items() if node.present}
        for _ in range(k, done):
            data = plant.sample()
            truth.append(plant.x)
            for i, node in present.items():
                p = design.nodes[i].p
                node.observer.sample(data[i][:p], data[i][p:])
            plant.advance()
        before = data
        rounds = {i: node.observer.rounds for i, node in present.items()}  # islands may need different numbers of them
        tally.rounds += max(rounds.values(), default=0)
        tally.messages += sum(count * len(design.nodes[i].tells) for i, count in rounds.items())
        for r in range(max(rounds.values(), default=0)):
            turn = {i: node for i, node in present.items() if r < rounds[i]}
            sent = {i: node.observer.message(r).copy() for i, node in turn.items()}
            for node in turn.values():
                received, late = node.network.next(k, r, sent)
                take_late(node.observer, late)
                node.observer.exchange(r, received)
        for node in nodes.values():
            node.write(done - k)
        progress(done)
    for node in nodes.values():
        tally.faults.update(node.network.counts)
    tally.messages += tally.faults["duplicate"]
    return split_trace(
        design,
        np.array(truth),
        {i: np.array(node.rows) for i, node in nodes.items()},
        {i: np.concatenate(node.seen) for i, node in nodes.items()},
    )


class _Node:
    """One node's observer, what reaches it, and what it has written."""

    def __init__(self, spec: NodeSpec) -> None:
        self.spec, self.present = spec, True
        self.rows, self.seen = list[Array](), list[Array]()
        self._missing = np.full(sum(part.size for part in make_observer(spec).estimate()), np.nan)
        self.begin(spec.steps)

    def begin(self, steps: int) -> None:
        """A new observer for the last ``steps`` steps, which knows nothing of earlier ones."""
        self.network = _InEdges(self.spec)
        self.observer = make_observer(replace(self.spec, steps=steps))
        self._read, self._look = reader(self.observer), watcher(self.observer)

    def write(self, steps: int) -> None:
        """The rows of the steps that are done; of a node that is not there, NaN."""
        if not self.present:
            self.rows += [self._missing] * steps
            return
        self.rows += [np.concatenate(estimate) for estimate in self._read()]
        self.seen.append(self._look())


def _come_and_go(design: Design, nodes: dict[int, _Node], k: int, before: Mapping[int, Array]) -> None:
    """Processes that are killed at the beginning of step k, and those that are back."""
    faults = design.scenario.faults
    for fault in faults.nodes:
        if fault.step != k or fault.what == "pause":  # a pause only takes time
            continue
        if design.scenario.run.on_node_loss == "stop":
            raise RunError(f"node-{fault.node} was killed at step {k}, as faults.nodes asks; run.on_node_loss is stop")
        nodes[fault.node].present = False
        for j in nodes[fault.node].spec.tells:
            part_with(nodes[j].observer, fault.node)
    back = faults.returns().get(k, ())
    told = {i: _told(nodes, i) if nodes[i].spec.warm else [] for i in back}  # before anybody of them is back
    for i in back:
        node, p = nodes[i], design.nodes[i].p
        node.present = True
        node.begin(design.plant.steps - k)
        start_again(node.observer, told[i], before.get(i, NOTHING), p)
        for j in node.spec.hears:
            if not nodes[j].present and j not in back:
                part_with(node.observer, j)
        for j in node.spec.tells:
            welcome(nodes[j].observer, i)


def _told(nodes: Mapping[int, _Node], i: int) -> list[Array]:
    """The greetings of those in-neighbours of node i that are there, in ascending order of id."""
    there = [nodes[j] for j in sorted(nodes[i].spec.hears) if nodes[j].present and nodes[j].rows]
    return [greeting(node.observer.estimate()) for node in there]


class _InEdges:
    """What reaches one node, as the faults of its in-edges will have it."""

    def __init__(self, spec: NodeSpec) -> None:
        self._hears = tuple(sorted(spec.hears))
        planned = spec.faults.rules or spec.faults.absent
        self._reception = Reception(spec.faults, spec.hears) if planned else None
        self._held: dict[Stamp, Array] = {}

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames by what the model did to them."""
        return {} if self._reception is None else self._reception.counts

    def next(self, k: int, r: int, sent: Mapping[int, Array]) -> tuple[dict[int, Array], list[Late]]:
        """The vectors of step k, round r that arrive in this very exchange, and older ones that arrive now."""
        if self._reception is None:
            return {j: sent[j] for j in self._hears}, []
        on_time, held, _, late = self._reception.next(k, r)
        arrived = [Late(s.source, k - s.k, s.r, self._held.pop(s)) for s in late]
        self._held |= {Stamp(j, k, r): sent[j] for j in held}
        return {j: sent[j] for j in on_time}, arrived


def split_trace(design: Design, x: Array, rows: dict[int, Array], watched: Mapping[int, Array]) -> Trace:
    """Cut every node's rows [x-hat | w-hat | v-hat | flag] (K, size) into the named arrays of a trace.

    There is a flag where messages can be missing. A row of NaN is a step without an estimate, and not flagged; an
    estimate that has left the floats is flagged whatever the node says.
    ``watched``: every node's rows (m, 3) of the rounds of one step; m = 0 where none was watched.
    """
    n, ids = design.scenario.plant.n, sorted(rows)
    q, r = reconstructs(design)
    xhat = np.stack([rows[i][:, :n] for i in ids])
    flagged = None
    if all(design.nodes[i].without for i in ids):
        flags = np.stack([rows[i][:, -1] for i in ids])
        flagged = (flags > 0) | (~np.isnan(flags) & ~np.isfinite(xhat).all(axis=2))
    return Trace(
        t=np.arange(x.shape[0], dtype=np.float64) * design.plant.step,
        x=x,
        node_ids=np.array(ids, dtype=np.int64),
        xhat=xhat,
        what=np.stack([rows[i][:, n : n + q] for i in ids]) if q else None,
        vhat={i: rows[i][:, n + q : n + q + r[i]] for i in ids if r[i]},
        rounds={i: rounds for i, rounds in watched.items() if len(rounds)},
        flagged=flagged,
    )


def reconstructs(design: Design) -> tuple[int, dict[int, int]]:
    """(q, {node: r_i}) that the method's estimates carry beside the state."""
    sizes = {i: make_observer(spec).estimate() for i, spec in design.nodes.items()}
    return max(e.unknown_input.size for e in sizes.values()), {i: e.noise.size for i, e in sizes.items()}


def estimate_sizes(design: Design) -> dict[int, int]:
    """Floats in one estimate row of each node."""
    return {i: sum(part.size for part in make_observer(s).estimate()) for i, s in design.nodes.items()}
