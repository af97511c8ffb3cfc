"""What a person sees in the terminal: progress, the certificate, the result. Only the command line uses it."""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column, Table

from duio_mesh import launcher
from duio_mesh.launcher import RunResult
from duio_mesh.report.losses import Rest, badness, rest
from duio_mesh.report.recovery import loss_in_words
from duio_mesh.report.timeliness import in_words
from duio_mesh.synthesis.contingency import radius_of
from duio_mesh.synthesis.design import Design

MANY = 16  # nodes or warnings, from which on only some are shown
QUIET = 5.0  # seconds without a word about a design in a log
RATE = len("10,000 steps/s")
FEW = 8  # nodes whose errors are shown one by one

_out = Console(highlight=False)
_err = Console(stderr=True, highlight=False)


@contextlib.contextmanager
def working(on: str) -> Iterator[Callable[[str], None]]:
    """Show that something is being done, and what part of it: in a log, a line every few seconds."""
    last = time.monotonic()

    def line(part: str) -> None:
        nonlocal last
        if time.monotonic() - last >= QUIET:
            last = time.monotonic()
            _err.print(f"{on}: {part}", soft_wrap=True, markup=False)

    if not _err.is_terminal:
        yield line
        return
    with _err.status(on) as status:
        yield lambda part: status.update(f"{on}: {escape(part)}")


@contextlib.contextmanager
def progress(design: Design) -> Iterator[launcher.Show]:
    """A bar with steps, steps per second, and every node's newest error."""
    steps = Column(no_wrap=True, min_width=2 * len(str(design.plant.steps)) + 1)
    rate = Column(no_wrap=True, min_width=RATE)  # in a narrow terminal it is the errors that are cut short
    columns = (
        BarColumn(bar_width=12),
        MofNCompleteColumn(table_column=steps),
        TextColumn("{task.fields[rate]}", table_column=rate),
        TextColumn("{task.fields[errors]}"),
    )
    with Progress(*columns, console=_err) as bar:
        task = bar.add_task("running", total=design.plant.steps, rate="", errors="starting the processes")

        def show(now: launcher.Progress) -> None:
            speed = bar.tasks[0].speed
            rate = f"{speed:,.0f} steps/s" if speed else ""
            errors = f"[yellow]{escape(now.note)}[/]" if now.note else errors_in_words(now.errors)
            bar.update(task, completed=now.steps, rate=rate, errors=errors)

        yield show


def clock(design: Design, *, processes: bool) -> None:
    """What a run on the wall clock is about to do, above all how long it will take."""
    if words := in_words(design.scenario.timing, design.plant.steps, processes=processes):
        _err.print(words, soft_wrap=True)


def errors_in_words(errors: Mapping[int, float]) -> str:
    """The newest error of every node, or of the best, the middle and the worst of many."""
    if len(errors) <= FEW:
        return " ".join(f"e{i} {e:.1e}" for i, e in sorted(errors.items()))
    ranked = sorted((e, i) for i, e in errors.items())
    chosen = (("best", ranked[0]), ("median", ranked[len(ranked) // 2]), ("worst", ranked[-1]))
    return "  ".join(f"{name} e{i} {e:.1e}" for name, (e, i) in chosen)


def chosen(nodes: Mapping[str, Mapping[str, Any]], by: str) -> list[tuple[str, Mapping[str, Any]]]:
    """(name, node) of all nodes where they are not many; else the worst ``FEW``, the worst first, median and best."""
    if len(nodes) <= MANY:
        return list(nodes.items())
    ranked = sorted(nodes.items(), key=lambda item: math.inf if item[1][by] is None else item[1][by], reverse=True)
    (middle, median), (last, best) = ranked[len(ranked) // 2], ranked[-1]
    return [*ranked[:FEW], (f"{middle} (median of {len(nodes)})", median), (f"{last} (best)", best)]


class Watcher:
    """Tells the person where to watch live, and keeps the server until they have seen enough."""

    def started(self, url: str) -> None:
        """The live server is there."""
        _err.print(f"watch live  rerun {url}", soft_wrap=True)

    def ended(self, url: str) -> None:
        """The run is over; returns when the server may go, at once where nobody is at the terminal."""
        if sys.stdin.isatty():
            _err.print(f"the run is over and still served at {url}; press Enter to end", soft_wrap=True)
            sys.stdin.readline()


def result(design: Design, result: RunResult, *, live: bool) -> None:
    """The table of errors, the verdict, and where everything is."""
    scenario, metrics = design.scenario, result.metrics
    table = Table()
    _out.print(f"[bold]{scenario.name}[/]: {scenario.method}, {len(scenario.nodes)} nodes, {metrics['steps']} steps")
    figures = {"RMS error": "rms", "final error": "final"}
    good, bad, what = "converged", "did not converge", "every node's RMS error"
    if scenario.outside:  # no truth, no error
        figures = {"disagreement": "disagreement", "residual": "residual"}
        good, bad = "the nodes agree", "the nodes do not agree"
        what = "every node's distance from the mean estimate, and what it measures from what the others expect,"
    for column in ("node", *figures):
        table.add_column(column, justify="right")
    names = list(figures.values())
    for name, node in chosen(metrics["nodes"], names[0]):
        table.add_row(name, *(_number(node[name]) for name in names))
    _out.print(table)
    wanted = scenario.run.convergence
    words = f"[green]{good}[/]" if result.converged else f"[red]{bad}[/]"
    if said := metrics.get("remarks"):
        words += f"[yellow]{', but ' if result.converged else '; '}{'; '.join(said)}[/]"
    _out.print(
        f"{words}: {what} over the last {wanted.over_last:.0%} of the run "
        f"{'is' if result.converged else 'should be'} below {wanted.rms_below:g}"
    )
    if scenario.outside:
        _out.print("(the true state is not known: that the nodes agree does not prove that they are right)")
    losses = metrics.get("recovery", [])
    for loss in losses[:FEW]:
        _out.print(loss_in_words(loss))
    if len(losses) > FEW:
        _out.print(f"and {len(losses) - FEW} further losses (recovery in metrics.json)")
    for warning in result.warnings[:MANY]:
        _out.print(f"[yellow]warning:[/] {warning}")
    if len(result.warnings) > MANY:
        _out.print(f"and {len(result.warnings) - MANY} further warnings (logs/)")
    _out.print(f"results    {result.folder}")
    recording = result.folder / "recording.rrd"
    if recording.exists():
        _out.print(f"open with  rerun {recording}", soft_wrap=True)


def certificate(design: Design) -> None:
    """What the design promises."""
    found = design.certificate
    _out.print(f"[bold]{design.scenario.name}[/]: {design.scenario.method}, {len(design.nodes)} nodes")
    conditions = Table("condition", "value", "needed", "", title="conditions")
    for name, condition in found["conditions"].items():
        mark = "[green]ok[/]" if condition["ok"] else "[red]no[/]"
        conditions.add_row(name, _text(condition["value"]), _text(condition["threshold"]), mark)
    _out.print(conditions)
    _out.print(_by_node(found["nodes"]))
    for name, value in found.items():
        if name not in ("conditions", "nodes", "contingency", "node_loss"):
            _out.print(f"{name:24} {_text(value)}")
    if cases := found.get("node_loss"):
        title = f"when a node is lost ({design.scenario.run.on_node_loss}): spectral radius of {radius_of(design)}"
        shown = chosen({case["lost"]: case for case in cases.values()}, "radius")
        _losses(title, cases.values(), ({**case, "lost": name} for name, case in shown))
    if "contingency" in found:
        said = found["contingency"]
        nothing = {"lost": "nothing", "radius": said["nominal"], "failing": said["nominal_failing"]}
        _losses(f"contingencies: spectral radius of {said['radius_of']}", said["cases"], (nothing, *said["cases"]))


def _losses(title: str, cases: Collection[Mapping[str, Any]], shown: Iterable[Mapping[str, Any]]) -> None:
    """What is left after each loss, and the worst of ``cases``."""
    table = Table("lost", "radius", "the rest", title=title)
    for case in shown:
        words = "[green]reconstructs[/]"
        if (left := rest(case)) is Rest.BAD:
            islands = " and ".join(_text(ids) for ids in case["failing"])
            words = f"[red]does not:[/] nodes {escape(islands)}"
        elif left is Rest.SLOW:
            words = f"[yellow]too slowly:[/] a step leaves {case['left']:.0%} of the error"
        table.add_row(case["lost"], _text(case["radius"]), words)
    _out.print(table)
    worst = max(cases, key=badness, default=None)
    counts = Counter(map(rest, cases))
    slowly = f", {counts[Rest.SLOW]} of them too slowly" if counts[Rest.SLOW] else ""
    _out.print(f"{'worst':24} {worst['lost'] if worst else '-'}")
    _out.print(f"{'survives':24} {len(cases) - counts[Rest.BAD]} of {len(cases)}{slowly}")


def _by_node(nodes: Mapping[Any, Mapping[str, Any]]) -> Table:
    """One row per quantity where the nodes are few, one row per node where they are many."""
    quantities = [key for key, value in next(iter(nodes.values())).items() if not isinstance(value, Mapping)]
    if len(nodes) > FEW:
        table = Table("node", *quantities, title="nodes")
        for i, node in nodes.items():
            table.add_row(str(i), *(_text(node.get(key)) for key in quantities))
        return table
    table = Table("", *(f"node {i}" for i in nodes), title="nodes")
    for key in quantities:
        table.add_row(key, *(_text(node.get(key)) for node in nodes.values()))
    return table


def plan(design: Design, *, record: bool) -> None:
    """What a run would start, and who would talk to whom."""
    if outside := design.plant.outside:
        where = f"listens on {outside.listen}" if outside.listen else f"connects to {outside.connect}"
        _say("duio-gateway", "gateway", "gateway", f"{where} for {', '.join(outside.sizes)}")
    else:
        _say("duio-plant", "plant", "plant", f"measures for {_text(list(design.nodes))}")
    for i, spec in design.nodes.items():
        talks = f"hears {_text(list(spec.hears))}, tells {_text(list(spec.tells))}"
        _say(f"duio-node-{i}", "node", f"node-{i}", talks)
    if record:
        _say("duio-recorder", "recorder", "recorder", "hears everybody")
    _out.print(f"{design.plant.steps} steps; links on loopback, along the edges, to the plant and to the recorder only")


def _say(name: str, module: str, spec: str, talks: str) -> None:
    _out.print(f"{name:14} python -m duio_mesh.{module} --spec nodes/{spec}.spec   {talks}", soft_wrap=True)


def _number(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _text(value: Any) -> str:
    """Plain data in one line."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "-"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_text(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_text(v) for v in value) + "]"
    return str(value)
