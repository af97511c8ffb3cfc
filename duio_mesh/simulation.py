"""The oracle: the same plant and observers in one process, without Zenoh. The mesh must equal it bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.dynamics import Plant
from duio_mesh.faults import Reception, Stamp
from duio_mesh.observers import make_observer
from duio_mesh.observers.absence import Late, take_late
from duio_mesh.observers.base import reader
from duio_mesh.observers.watch import watcher
from duio_mesh.spec import NodeSpec
from duio_mesh.synthesis.design import Design
from duio_mesh.trace import Trace as Trace  # re-exported: it lives lower, where report/ may import it


def simulate(design: Design, progress: Callable[[int], None] = lambda _: None) -> Trace:
    """Run plant and observers in lockstep; ``progress`` is called with the number of finished steps."""
    plant = Plant(design.plant)
    observers = {i: make_observer(spec) for i, spec in design.nodes.items()}
    network = {i: _InEdges(spec) for i, spec in design.nodes.items()}
    truth, rows = [], {i: list[Array]() for i in observers}
    steps, batch = design.plant.steps, design.scenario.run.batch
    watched = {i: (watcher(observer), list[Array]()) for i, observer in observers.items()}
    for k in range(0, steps, batch):
        done = min(k + batch, steps)
        for _ in range(k, done):
            data = plant.sample()
            truth.append(plant.x)
            for i, observer in observers.items():
                p = design.nodes[i].p
                observer.sample(data[i][:p], data[i][p:])
            plant.advance()
        rounds = {i: o.rounds for i, o in observers.items()}  # islands may need different numbers of them
        for r in range(max(rounds.values())):
            turn = {i: o for i, o in observers.items() if r < rounds[i]}
            sent = {i: o.message(r).copy() for i, o in turn.items()}
            for i, observer in turn.items():
                received, late = network[i].next(k, r, sent)
                take_late(observer, late)
                observer.exchange(r, received)
        for i, observer in observers.items():
            rows[i] += [np.concatenate(estimate) for estimate in reader(observer)()]
            look, seen = watched[i]
            seen.append(look())
        progress(done)
    return split_trace(
        design,
        np.array(truth),
        {i: np.array(r) for i, r in rows.items()},
        {i: np.concatenate(seen) for i, (_, seen) in watched.items()},
    )


class _InEdges:
    """What reaches one node, as the faults of its in-edges will have it."""

    def __init__(self, spec: NodeSpec) -> None:
        self._hears = tuple(sorted(spec.hears))
        self._reception = Reception(spec.faults, spec.hears) if spec.faults.rules else None
        self._held: dict[Stamp, Array] = {}

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
