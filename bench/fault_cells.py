"""Every observer under every kind of fault: the runs and the faults of docs/reliability.md, and how one is judged."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from duio_mesh import load_scenario, run, simulate, synthesise
from duio_mesh.arrays import Array
from duio_mesh.report.recovery import ROUNDING, TWICE, WINDOW
from duio_mesh.scenario.model import Graph
from duio_mesh.simulation import Trace
from duio_mesh.synthesis.design import Design

TOPOLOGIES = Path(__file__).parent.parent / "topologies"
SEED = 2026  # of the faults; plant and noise keep the topology's own seed
AWAY = 10  # steps that a node is away that is killed and comes back
PAUSE = 0.3  # seconds
PATIENT = 30.0  # seconds of run.deadline in the mesh: a busy machine is not a fault that is looked at here


class Case(NamedTuple):
    """An observer on a graph."""

    name: str
    topology: str
    steps: int
    during: tuple[int, int]  # steps of the faults, with room before them to converge and after them to recover
    changes: dict[str, Any] = {}  # noqa: RUF012 (nobody writes to it)
    kinds: tuple[str, ...] = ()  # only these kinds of faults
    longer: int = 0  # steps more for a node that comes back: what its local estimator takes to settle

    @property
    def graph(self) -> str:
        """Ring, star, ..."""
        return self.name.split(", ")[1]


class Fault(NamedTuple):
    """What is changed in a topology, and in which steps it goes wrong."""

    kind: str
    changes: dict[str, Any]
    span: tuple[int, int]
    gone: int = 0  # the node that never comes back
    steps: int = 0  # more than the case has


LINKS: dict[str, tuple[str, dict[str, Any]]] = {
    "loss 1 %": ("losses", {"loss": 0.01}),
    "loss 5 %": ("losses", {"loss": 0.05}),
    "loss 20 %": ("losses", {"loss": 0.2}),
    "bursts": ("losses", {"gilbert_elliott": {"worsen": 0.05, "mend": 0.25}}),
    "delay 0 or 1": ("delays", {"delay": {"steps": [0, 1]}}),
    "delay 1": ("delays", {"delay": {"steps": 1}}),
    "delay 3": ("delays", {"delay": {"steps": 3}}),
    "duplicates 20 %": ("frames", {"duplicate": 0.2}),
    "reordering 5 %": ("frames", {"reorder": 0.05}),
    "corruption 1 %": ("frames", {"corrupt": 0.01}),
}
STAR4 = {"graph.edges": [[1, 2], [1, 3], [1, 4]]}
STAR6 = {"graph.edges": [[1, 2], [1, 3], [1, 4], [1, 5], [1, 6]]}
ISLANDS = {"graph.edges": [[1, 2], [3, 4]]}
GLOBAL = {"observer.setup": "global"}  # a set-up by the nodes forgives nothing, and nobody can join it later
CLOSE = {"run.convergence.rms_below": 0.1}
QUIET = CLOSE | {"plant.noise": 0}
EXACT = {"observer": {"method": "admm", "fusion": "finite_time", "stable_radius": 0.97}}
RELAXED = {"observer": {"method": "admm", "fusion": "relaxed", "rounds": 110, "c": 0.01, "stable_radius": 0.97}}
LATE = ("losses", "delays")
CASES = (
    Case("lmi, ring", "ring", 350, (100, 160)),
    Case("lmi, star", "star", 350, (100, 160)),
    Case("lmi, two islands", "partitioned", 350, (100, 160)),
    Case("lmi, unstable ring", "six_state_ring", 800, (350, 400), QUIET),
    Case("lmi, unstable ring, hold", "six_state_ring", 800, (350, 400), {**QUIET, "observer.without": "hold"}, LATE),
    Case("augmented, ring", "augmented_heat_ring", 350, (100, 160)),
    Case("augmented, star", "augmented_heat_ring", 350, (100, 160), STAR4),
    Case("augmented, two islands", "augmented_heat_ring", 350, (100, 160), ISLANDS),
    Case("augmented, path", "augmented_example9", 300, (80, 130)),
    Case("augmented, unstable ring", "augmented_six_state", 500, (200, 250), CLOSE),
    Case("admm, ring", "admm_ring", 52, (20, 30), longer=640),
    Case("admm, star", "admm_star", 52, (20, 30), GLOBAL, longer=640),
    Case("admm, two islands", "admm_partitioned", 52, (20, 30), longer=120),
    Case("admm finite_time, ring", "finite_time_ring", 250, (40, 100), GLOBAL, longer=560),
    Case("admm finite_time, star", "finite_time_ring", 250, (40, 100), GLOBAL | STAR4, longer=560),
    Case("admm finite_time, two islands", "admm_partitioned", 250, (40, 100), EXACT),
    Case("admm relaxed, ring", "relaxed_ring", 52, (20, 30), longer=640),
    Case("admm relaxed, star", "relaxed_ring", 52, (20, 30), STAR4 | {"observer.rounds": 120}, longer=640),
    Case("admm relaxed, two islands", "admm_partitioned", 52, (20, 30), RELAXED, longer=120),
    Case("geometric, ring", "geometric_ring", 2400, (1500, 1600)),
    Case("geometric, star", "geometric_star", 2800, (1700, 1800), longer=600),
    Case("geometric, ring, pair", "geometric_ring", 2400, (1500, 1600), {"observer.without": "pair"}, LATE),
    Case("reduced_order, ring", "reduced_order_newengland18", 1300, (980, 1040)),
    Case("reduced_order, star", "reduced_order_newengland18", 1300, (980, 1040), STAR6),
    Case("reduced_order, ring with a chord", "reduced_order_kundur8", 1300, (980, 1040)),
    Case("reduced_order, ring with a chord, pair", "reduced_order_kundur8", 1300, (980, 1040),
         {"observer.without": "pair"}, LATE),
)  # fmt: skip


class Cell(NamedTuple):
    """One case under one fault. Errors are RMS per component of the state, of the worst node."""

    case: str
    fault: str
    kind: str
    during: float  # over the steps of the fault
    final: float  # over the last WINDOW steps
    clean: float  # the same without faults
    flagged: float  # share of the estimates from the fault's first step on
    trusted: float  # worst WINDOW estimates in a row of those that are not flagged; NaN when all are
    steps: int | None  # from the end of the fault (or a loss for good) until everybody's error is back; None: never
    doubted: int | None  # from the end of the fault until nobody flags an estimate any more; None: never
    verdict: str
    same: bool | None = None  # whether the mesh equalled the oracle; None: not tried


def faults_of(case: Case, graph: Graph) -> Iterator[tuple[str, Fault]]:
    """Every fault of a case, by its name. The node with most neighbours is the one that is cut off and comes back."""
    a, b = case.during
    most = max(graph.ids, key=lambda i: len(graph.hears(i)))
    fewest = min(reversed(graph.ids), key=lambda i: len(graph.hears(i)))
    arcs = [[x.source, x.target] for x in graph.arcs]
    for name, (kind, link) in LINKS.items():
        yield name, Fault(kind, {"faults": {"links": [link | {"during": [a, b]}]}}, (a, b))
    cuts = {"one edge cut, healed": arcs[:1], "partition, healed": [e for e in arcs if most in e]}
    key = "arcs" if graph.directed else "edges"
    for name, edges in cuts.items():
        cut = {key: edges if graph.directed else sorted({tuple(sorted(e)) for e in edges}), "during": [a, b]}
        yield name, Fault("cuts", {"faults": {"cuts": [cut]}}, (a, b))
    node = {"node": most, "restart": a, "away": AWAY}
    policy: dict[str, Any] = {"run.on_node_loss": "restart"}
    if case.longer and case.name.startswith("admm"):
        policy["run.batch"] = AWAY  # the same estimates in fewer rounds
    yield "kill, restart", Fault("processes", policy | {"faults": {"nodes": [node]}}, (a, a + AWAY), steps=case.longer)
    policy = {"run.on_node_loss": "degrade"}
    for name, i in (("kill, degrade (hub)", most), ("kill, degrade (leaf)", fewest)):
        yield name, Fault("processes", policy | {"faults": {"nodes": [{"node": i, "kill": a}]}}, (a, case.steps), i)
    pause = {"node": most, "pause": a, "seconds": PAUSE}
    yield "pause, resume", Fault("processes", {"faults": {"nodes": [pause]}}, (a, a))


def design_of(case: Case, changes: dict[str, Any], longer: int = 0) -> Design:
    """The design of a case with the changes of a fault, for so many steps more."""
    faults = {"faults": changes["faults"] | {"seed": SEED}} if changes else {}
    steps = {"run.steps": case.steps + longer, "run.deadline": PATIENT}
    return synthesise(load_scenario(TOPOLOGIES / f"{case.topology}.yaml", **steps | case.changes | changes | faults))


def cells(cases: tuple[Case, ...], mesh: bool, names: Collection[str] = ()) -> Iterator[Cell]:
    """Every case under every fault (or those of these names); with ``mesh``, also as processes over Zenoh."""
    for case in cases:
        plain = design_of(case, {}, case.longer)
        ideal, limit = simulate(plain), plain.scenario.run.convergence.rms_below
        clean = errors(ideal)
        if not worst(clean[:, case.during[0] - WINDOW :]) < limit:
            raise SystemExit(f"{case.name}: not below {limit} without any fault from step {case.during[0] - WINDOW} on")
        for name, fault in faults_of(case, plain.scenario.graph):
            if (case.kinds and fault.kind not in case.kinds) or (names and name not in names):
                continue
            design = design_of(case, fault.changes, fault.steps)
            trace = simulate(design)
            cell = judged(case.name, name, fault, trace, clean[:, : len(trace.t)], limit)
            yield cell._replace(same=equals(design, trace)) if mesh else cell


def equals(design: Design, oracle: Trace) -> bool:
    """Whether a run of real processes gives the oracle's bits: estimates, reconstructed inputs and flags.

    SystemExit where no frame met with a fault: such a cell would say nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        result = run(design, Path(folder) / "run", record=False)
    found, wanted, faults = result.trace.arrays(), oracle.arrays(), design.scenario.faults
    happened = Counter(event["event"] for event in result.metrics["events"])
    planned = Counter(fault.what for fault in faults.nodes)
    if faults.links and not any(result.metrics["faults"].values()):
        raise SystemExit(
            f"{design.scenario.name}: no frame was lost, late, corrupt or sent twice; other steps or another seed"
        )
    return (
        found.keys() == wanted.keys()
        and all(found[name].tobytes() == values.tobytes() for name, values in wanted.items())
        and happened["death"] == planned["kill"] + planned["restart"]
        and happened["back"] == planned["restart"]
        and happened["resumed"] == planned["pause"]
    )


def errors(trace: Trace) -> Array:
    """(N, K): RMS over the components; NaN where a node is away, infinite where an estimate left the floats."""
    with np.errstate(over="ignore", invalid="ignore"):
        e = np.sqrt(np.mean((trace.xhat - trace.x) ** 2, axis=2))
    return np.where(trace.lost, np.nan, np.where(np.isnan(e), np.inf, e))


def windows(e: Array) -> Array:
    """(K - WINDOW + 1,) RMS over WINDOW of the K values from each on."""
    with np.errstate(over="ignore"):
        return np.asarray(np.sqrt(np.mean(sliding_window_view(e, WINDOW) ** 2, axis=1)))


def worst(e: Array) -> float:
    """The largest RMS of any node over WINDOW values in a row (or the fewer that there are), leaving out NaN."""
    kept = [row[~np.isnan(row)] for row in e]
    return float(
        max((windows(row).max() if len(row) >= WINDOW else rms([row]) for row in kept if len(row)), default=np.nan)
    )


def rms(rows: Iterable[Array]) -> float:
    """Of the worst node, over all its values but NaN; NaN where nobody has any."""
    kept = [row[~np.isnan(row)] for row in rows]
    with np.errstate(over="ignore"):
        return float(max((np.sqrt(np.mean(row**2)) for row in kept if len(row)), default=np.nan))


def back(e: Array, clean: Array, floor: float, a: int, start: int) -> int | None:
    """Steps from ``start`` on until one node's error (K,) has come back to TWICE its level, and stays there.

    Error and level are RMS over the WINDOW steps from each on; the level is that of the WINDOW steps before step a, or
    the fault-free run's in the same steps where it is larger there, and at least ``floor``. None: not before the end.
    """
    level = np.maximum(max(rms([e[a - WINDOW : a]]), floor), windows(clean)[start:])
    above = np.flatnonzero(~(windows(e)[start:] <= TWICE * level))
    steps = int(above[-1]) + 1 if len(above) else 0
    return steps if steps < len(level) else None


def judged(case: str, name: str, fault: Fault, trace: Trace, clean: Array, limit: float) -> Cell:
    """right: since WINDOW steps before the fault any WINDOW estimates in a row are as good as the topology asks.

    flagged: not so, but any WINDOW in a row of those that are not flagged. **WRONG**: neither.
    """
    a, b = fault.span
    start, since = a if fault.gone else b, a - WINDOW
    e = errors(trace)
    flags = np.zeros(e.shape, dtype=bool) if trace.flagged is None else trace.flagged
    trusted = worst(np.where(flags, np.nan, e)[:, since:])
    verdict = "right" if worst(e[:, since:]) < limit else "**WRONG**" if trusted >= limit else "flagged"
    floor = ROUNDING * float(np.sqrt(np.mean(trace.x[since:a] ** 2)))
    there = [at for at, i in enumerate(trace.node_ids.tolist()) if i != fault.gone]
    steps = [back(e[at], clean[at], floor, a, start) for at in there]
    late = np.flatnonzero(flags[:, start:].any(axis=0))
    doubted = int(late[-1]) + 1 if len(late) else 0
    return Cell(
        case=case,
        fault=name,
        kind=fault.kind,
        during=rms(e[:, a:b]),
        final=rms(e[:, -WINDOW:]),
        clean=rms(clean[:, -WINDOW:]),
        flagged=float(flags[:, a:][~trace.lost[:, a:]].mean()),
        trusted=trusted,
        steps=None if None in steps else max(k for k in steps if k is not None),
        doubted=None if doubted == len(trace.t) - start else doubted,
        verdict=verdict,
    )
