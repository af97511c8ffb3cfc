"""What a person sees in the terminal: progress, the certificate, the result. Only the command line uses it."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Column, Table
from rich.text import Text

from duio_mesh import launcher
from duio_mesh.launcher import RunResult
from duio_mesh.report.description import needed
from duio_mesh.report.losses import Rest, badness, rest
from duio_mesh.report.recovery import loss_in_words
from duio_mesh.report.timeliness import in_words
from duio_mesh.synthesis.contingency import radius_of
from duio_mesh.synthesis.design import Design

MANY = 16  # nodes or warnings, from which on only some are shown
QUIET = 5.0  # seconds without a word about a design in a log
RATE = len("10,000 steps/s")
FEW = 8  # nodes whose errors are shown one by one
CELL = 24  # characters of a table's cell; what is longer has lines of its own below

APART = ("conditions", "nodes", "contingency", "node_loss")  # of a certificate: has a table of its own

Part = str | tuple[str, str]
"""Of a line: the text, or the text and its style."""


class Terminal(Console):
    """A console that takes what it prints as it is, and outlives its reader.

    Names and paths are the user's: a bracket in them is no markup, and a word between colons no emoji.
    """

    def __init__(self, *, stderr: bool = False) -> None:
        super().__init__(stderr=stderr, highlight=False, markup=False, emoji=False)

    def on_broken_pipe(self) -> None:
        """The reader has seen enough (`| head`): that says nothing about the run, so its exit code stays."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        with contextlib.suppress(OSError):  # a stream without a descriptor
            os.dup2(nowhere, self.file.fileno())  # what Python still holds for it when it exits goes there too
        os.close(nowhere)

    def say(self, *parts: Part) -> None:
        """Print one line, which stays one in a log or a pipe however long it is."""
        self.print(Text.assemble(*parts), soft_wrap=True)


_out = Terminal()
_err = Terminal(stderr=True)


@contextlib.contextmanager
def working(on: str) -> Iterator[Callable[[str], None]]:
    """Show that something is being done, and what part of it: in a log, a line every few seconds."""
    last = time.monotonic()

    def line(part: str) -> None:
        nonlocal last
        if time.monotonic() - last >= QUIET:
            last = time.monotonic()
            _err.say(f"{on}: {part}")

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
        _err.say(words)


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
        _err.say(f"watch live  rerun {url}")

    def ended(self, url: str) -> None:
        """The run is over; returns when the server may go, at once where nobody is at the terminal."""
        if sys.stdin.isatty():
            _err.say(f"the run is over and still served at {url}; press Enter to end")
            sys.stdin.readline()


def result(design: Design, result: RunResult, *, live: bool) -> None:
    """The table of errors, the verdict, and where everything is."""
    _title(design, _count(result.metrics["steps"], "step"))
    _errors(design, result)
    _verdict(design, result)
    losses = result.metrics.get("recovery", [])
    for loss in losses[:FEW]:
        _out.say(loss_in_words(loss))
    if more := len(losses) - len(losses[:FEW]):
        _out.say(f"and {_count(more, 'further loss', 'further losses')} (recovery in metrics.json)")
    for warning in result.warnings[:MANY]:
        _out.say(("warning:", "yellow"), f" {warning}")
    if more := len(result.warnings) - len(result.warnings[:MANY]):
        _out.say(f"and {_count(more, 'further warning')} (logs/)")
    _out.say(f"results    {result.folder}")
    recording = result.folder / "recording.rrd"
    if recording.exists():
        _out.say(f"open with  rerun {recording}")


def _title(design: Design, *further: str) -> None:
    """Which file, which method, how many nodes."""
    scenario = design.scenario
    _out.say((scenario.name, "bold"), ": ", ", ".join((scenario.method, _count(len(scenario.nodes), "node"), *further)))


def _errors(design: Design, result: RunResult) -> None:
    """How far every node was off."""
    figures = {"RMS error": "rms", "final error": "final"}
    if design.scenario.outside:  # no truth, no error
        figures = {"disagreement": "disagreement", "residual": "residual"}
    names = list(figures.values())
    table = Table(*(_column(name, right=True) for name in ("node", *figures)))
    for name, node in chosen(result.metrics["nodes"], names[0]):
        table.add_row(name, *(_number(node[name]) for name in names))
    _out.print(table)


def _verdict(design: Design, result: RunResult) -> None:
    """Whether it converged, what that means, and what is to be said against it."""
    good, bad, what = "converged", "did not converge", "every node's RMS error"
    if design.scenario.outside:
        good, bad = "the nodes agree", "the nodes do not agree"
        what = "every node's distance from the mean estimate, and what it measures from what the others expect,"
    wanted = design.scenario.run.convergence
    words: list[Part] = [(good, "green") if result.converged else (bad, "red")]
    if said := result.metrics.get("remarks"):
        words.append((f"{', but ' if result.converged else '; '}{'; '.join(said)}", "yellow"))
    _out.say(
        *words,
        f": {what} over the last {100 * wanted.over_last:.3g}% of the run "
        f"{'is' if result.converged else 'should be'} below {wanted.rms_below:g}",
    )
    if design.scenario.outside:
        _out.say("(the true state is not known: that the nodes agree does not prove that they are right)")


def certificate(design: Design) -> None:
    """What the design promises."""
    found = design.certificate
    _title(design)
    conditions = Table(*map(_column, ("condition", "value", "needed")), Column(no_wrap=True), title="conditions")
    for name, condition in found["conditions"].items():
        mark = Text("ok", "green") if condition["ok"] else Text("no", "red")
        conditions.add_row(name, _text(condition["value"]), needed(condition), mark)
    _out.print(conditions)
    _by_node(found["nodes"])
    plain = {name: value for name, value in found.items() if name not in APART}
    width = max(map(len, plain), default=0)
    for name, value in plain.items():
        _out.print(f"{name:{width}} {_text(value)}")
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
    table = Table(*map(_column, ("lost", "radius", "the rest")), title=title)
    for case in shown:
        table.add_row(case["lost"], _text(case["radius"]), _rest(case))
    _out.print(table)
    worst = max(cases, key=badness, default=None)
    counts = Counter(map(rest, cases))
    slowly = f", {counts[Rest.SLOW]} of them too slowly" if counts[Rest.SLOW] else ""
    _out.say(f"{'worst':24} {worst['lost'] if worst else '-'}")
    _out.say(f"{'survives':24} {len(cases) - counts[Rest.BAD]} of {len(cases)}{slowly}")


def _rest(case: Mapping[str, Any]) -> Text:
    """What the others still do after a loss."""
    if (left := rest(case)) is Rest.BAD:
        islands = " and ".join(_text(ids) for ids in case["failing"])
        return Text.assemble(("does not:", "red"), f" nodes {islands}")
    if left is Rest.SLOW:
        return Text.assemble(("too slowly:", "yellow"), f" a step leaves {case['left']:.0%} of the error")
    return Text("reconstructs", "green")


def _by_node(nodes: Mapping[Any, Mapping[str, Any]]) -> None:
    """One row per quantity where the nodes are few, one row per node where they are many; then what is long."""
    quantities = [key for key, value in next(iter(nodes.values())).items() if not isinstance(value, Mapping)]
    columns = {key: [_text(node.get(key)) for node in nodes.values()] for key in quantities}
    short = {key: cells for key, cells in columns.items() if max(map(cell_len, cells)) <= CELL}
    if len(nodes) > FEW:
        _side_by_side("node", list(map(str, nodes)), short)
    else:
        cells = zip(*short.values(), strict=True)
        _side_by_side("", list(short), {f"node {i}": list(own) for i, own in zip(nodes, cells, strict=bool(short))})
    for key in (key for key in columns if key not in short):
        _out.say(f"{key}:")
        lines = Table.grid(Column(no_wrap=True), Column(overflow="fold"), padding=(0, 1))
        for i, text in zip(nodes, columns[key], strict=True):
            lines.add_row(f"node {i}", text)
        _out.print(Padding(lines, (0, 0, 0, 2), expand=False))


def _side_by_side(corner: str, names: list[str], columns: Mapping[str, list[str]]) -> None:
    """A table with a row for each of ``names``, or several below one another where it is wider than the console."""

    def width(head: str, cells: Iterable[str]) -> int:
        return max(map(cell_len, (head, *cells))) + len("│  ")

    first = width(corner, names) + len("│")
    groups: list[list[str]] = []
    room = 0
    for head, cells in columns.items():
        if not groups or width(head, cells) > room:
            groups.append([])
            room = _out.width - first
        groups[-1].append(head)
        room -= width(head, cells)
    for at, group in enumerate(groups, 1):
        title = "nodes" if len(groups) == 1 else f"nodes ({at} of {len(groups)})"
        table = Table(Column(corner, no_wrap=True), *map(_column, group), title=title)
        for row in zip(names, *(columns[head] for head in group), strict=True):
            table.add_row(*row)
        _out.print(table)


def _column(name: str, *, right: bool = False) -> Column:
    """A column whose cells are broken where they do not fit, never cut."""
    return Column(name, justify="right" if right else "left", overflow="fold")


def written(what: str, path: Path) -> None:
    """Where something is now."""
    _out.say(f"{what:10} {path}")


def plan(design: Design, *, record: bool) -> None:
    """What a run would start, and who would talk to whom."""
    if outside := design.plant.outside:
        where = f"listens on {outside.listen}" if outside.listen else f"connects to {outside.connect}"
        _process("duio-gateway", "gateway", f"{where} for {', '.join(outside.sizes)}")
    else:
        _process("duio-plant", "plant", f"measures for {_text(list(design.nodes))}")
    for i, spec in design.nodes.items():
        _process(f"duio-node-{i}", "node", f"hears {_text(list(spec.hears))}, tells {_text(list(spec.tells))}")
    if record:
        _process("duio-recorder", "recorder", "hears everybody")
    steps = _count(design.plant.steps, "step")
    _out.say(f"{steps}; links on loopback, along the edges, to the plant and to the recorder only")
    _out.say(
        "each is a Python module with its own spec, which gets its endpoints when a run starts or by `launch.py export`"
    )


def _process(name: str, module: str, what: str) -> None:
    """One process: its name, what it runs (no command: without endpoints it could not), what it does."""
    _out.say(f"{name:14} {f'duio_mesh.{module}':18}  {what}")


def _count(number: int, one: str, many: str = "") -> str:
    """The number and its noun: 1 node, 2 nodes."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"


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
