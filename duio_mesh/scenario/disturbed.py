"""The faults of a topology, checked against its graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from duio_mesh.faults import ALWAYS, Faults, NodeFault, Rule
from duio_mesh.scenario import model, schema
from duio_mesh.scenario.problems import Path, Problems, counted, listed
from duio_mesh.scenario.validate import whole

Arc = tuple[int, int]
AWAY = 10  # steps (blocks of run.batch) that a restarted node is away when the file does not say


def read_faults(written: Any, graph: model.Graph | None, run: Mapping[str, Any], problems: Problems) -> Faults:
    """The faults, by the settings of ``run``: its seed, when they have none of their own, and what to do about a loss.

    Rules are numbered in the order of the file, links before cuts: the number is part of the key of a rule's draws.
    """
    path: Path = ("faults",)
    seed = run.get("seed", 0)
    if written is None:
        return Faults(seed)
    faults = whole(schema.Faults, written, path, problems)
    if faults is None:
        return Faults(seed)
    rules: dict[Arc, list[Rule]] = {}
    entries: list[tuple[str, int, schema.Affected]] = [("links", k, link) for k, link in enumerate(faults.links)]
    entries += [("cuts", k, cut) for k, cut in enumerate(faults.cuts)]
    for number, (key, k, entry) in enumerate(entries):
        rule = _rule(number, entry, (*path, key, k), problems)
        _check_step(rule.during[0], (*path, key, k, "during"), run, problems)
        for arc in _arcs(entry, (*path, key, k), graph, problems):
            rules.setdefault(arc, []).append(rule)
    nodes = [_node(fault, (*path, "nodes", k), graph, run, problems) for k, fault in enumerate(faults.nodes)]
    _check_order(nodes, (*path, "nodes"), problems)
    links = {arc: tuple(several) for arc, several in sorted(rules.items())}
    return Faults(seed if faults.seed is None else faults.seed, links, tuple(nodes))


def _rule(number: int, entry: schema.Affected, path: Path, problems: Problems) -> Rule:
    during = (entry.during[0], entry.during[1]) if entry.during is not None else ALWAYS
    if not isinstance(entry, schema.LinkFault):
        return Rule(number, during, loss=1.0)
    delay, burst = entry.delay, entry.gilbert_elliott
    return Rule(
        number,
        during,
        loss=entry.loss,
        burst=(burst.worsen, burst.mend, burst.good, burst.bad) if burst else (),
        delay_steps=_range(delay.steps, (*path, "delay", "steps"), problems) if delay else (0, 0),
        delay_rounds=_range(delay.rounds, (*path, "delay", "rounds"), problems) if delay else (0, 0),
        duplicate=entry.duplicate,
        reorder=entry.reorder,
        corrupt=entry.corrupt,
    )


def _range(written: int | list[int] | None, path: Path, problems: Problems) -> tuple[int, int]:
    if written is None:
        return (0, 0)
    least, most = (written, written) if isinstance(written, int) else written
    if least > most:
        problems.at(path, f"should be [least, most], not {[least, most]}")
    return (least, most)


def _arcs(entry: schema.Affected, path: Path, graph: model.Graph | None, problems: Problems) -> Iterable[Arc]:
    """The directed edges that an entry means: both directions of an edge, as far as the graph has them."""
    there = {(a.source, a.target) for a in graph.arcs} if graph is not None else None
    if entry.edges is None and entry.arcs is None:
        return sorted(there or ())
    found: dict[Arc, None] = {}
    key = "edges" if entry.edges is not None else "arcs"
    for k, (i, j) in enumerate(entry.edges or entry.arcs or ()):
        wanted = [(i, j), (j, i)] if key == "edges" else [(i, j)]
        present = [arc for arc in wanted if there is None or arc in there]
        if not present:
            hint = "; arcs go from source to target" if key == "arcs" and there and (j, i) in there else ""
            kind = "an edge" if key == "edges" else "an arc"
            problems.at((*path, key, k), f"[{i}, {j}] is not {kind} of the graph{hint}")
        found |= dict.fromkeys(present)
    return found


def _node(
    fault: schema.NodeFault, path: Path, graph: model.Graph | None, run: Mapping[str, Any], problems: Problems
) -> NodeFault:
    if graph is not None and graph.ids and fault.node not in graph.ids:
        problems.at((*path, "node"), f"no such node: {fault.node}; the nodes are {listed(graph.ids, 'and')}")
    policy, batch = run.get("on_node_loss", "stop"), run.get("batch", 1)
    what = next(name for name in fault.forms if getattr(fault, name) is not None)
    _check_step(getattr(fault, what), (*path, what), run, problems)
    if fault.kill is not None:
        if policy == "restart":
            problems.at(
                (*path, "kill"),
                "under run.on_node_loss: restart say when the node is back, so that the run can be repeated: "
                "{node, restart: step, away: steps}",
            )
        _check_block(fault.kill, (*path, "kill"), batch, problems)
        return NodeFault(fault.node, "kill", fault.kill)
    if fault.restart is not None:
        if policy != "restart":
            problems.at((*path, "restart"), f"needs run.on_node_loss: restart (it is {policy})")
        away = AWAY * batch if fault.away is None else fault.away
        _check_block(fault.restart, (*path, "restart"), batch, problems)
        _check_block(away, (*path, "away"), batch, problems)
        return NodeFault(fault.node, "restart", fault.restart, away=away)
    return NodeFault(fault.node, "pause", fault.pause or 0, fault.seconds or 0.0)


def _check_step(step: int, path: Path, run: Mapping[str, Any], problems: Problems) -> None:
    """A fault that begins after the end would never happen; that it lasts longer than the run does no harm."""
    steps = run.get("steps")
    if steps is not None and step >= steps:
        problems.at(path, f"there is no step {step} in a run of {counted(steps, 'step')}")


def _check_block(step: int, path: Path, batch: int, problems: Problems) -> None:
    if step % batch:
        problems.at(path, f"should be a multiple of run.batch = {batch}: a node comes and goes between two blocks")


def _check_order(nodes: Sequence[NodeFault], path: Path, problems: Problems) -> None:
    """Nothing happens to a process while it is not there."""
    for k, fault in enumerate(nodes):
        others = Faults(nodes=tuple(other for other in nodes if other is not fault)).absences(fault.node)
        for first, after in others:
            if first <= fault.step <= after:
                until = "for good" if after == ALWAYS[1] else f"and back in step {after}"
                problems.at(
                    (*path, k, fault.what), f"node {fault.node} is not there: it is gone from step {first} {until}"
                )
