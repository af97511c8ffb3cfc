"""Runs a design as processes: hands each its spec, watches them, and gathers what they leave.

The launcher itself never opens a Zenoh session: it knows its children through the nursery, their reports and their
journals, and so it cannot disturb the mesh.
"""

from __future__ import annotations

import contextlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from duio_mesh import credentials
from duio_mesh.account import Account
from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.faults import COUNTED
from duio_mesh.limits import check_files
from duio_mesh.recovery import Recovery
from duio_mesh.report.description import describe
from duio_mesh.report.metrics import metrics
from duio_mesh.report.timeliness import timeliness, untimely
from duio_mesh.report.trace_file import write_trace
from duio_mesh.run_folder import RunFolder
from duio_mesh.scenario.model import Scenario
from duio_mesh.simulation import Tally, Trace, estimate_sizes, reconstructs, simulate
from duio_mesh.spec import AnySpec, NodeSpec, RecorderSpec, Wire, write_spec
from duio_mesh.supervisor import Supervisor
from duio_mesh.synthesis.design import Design
from duio_mesh.wiring import LOOPBACK, Wiring, check_address

CLOSING = 10.0  # seconds for the recorder to fill gaps and close its file ...
CLOSING_ROWS = 50_000  # ... and a second more for every so many rows
BRIEF = 2  # waits that the progress line names


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    steps: int  # finished by every node
    errors: Mapping[int, float]  # node id -> RMS over the states of its newest error; empty before
    note: str = ""  # for what everybody is waiting


Show: TypeAlias = Callable[[Progress], None]


class Watcher(Protocol):
    """Whoever wants to know where to watch live."""

    def started(self, url: str) -> None:
        """The live server is there."""
        ...

    def ended(self, url: str) -> None:
        """The run is over; the server stays until this returns."""
        ...


def ignore(_: Progress) -> None:
    """Show nothing."""


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    folder: Path
    trace: Trace
    metrics: Mapping[str, Any]
    converged: bool  # as the file asks; where nobody knows the truth: whether the nodes agree
    warnings: tuple[str, ...]  # what went wrong without stopping the run


def specs_of(
    design: Design, folder: RunFolder, wires: Mapping[str, Wire], *, record: bool, live: bool
) -> dict[str, AnySpec]:
    """Every process' spec, with the endpoints and the files that it gets."""
    sizes, run = estimate_sizes(design), design.scenario.run
    source = "gateway" if design.plant.outside else "plant"
    specs: dict[str, AnySpec] = {
        source: replace(design.plant, wire=wires["plant"], output=str(folder.rows(source)), recorded=record)
    }
    for i, spec in design.nodes.items():
        who = f"node-{i}"
        inputs = str(folder.inputs(who)) if run.inputs else ""
        specs[who] = replace(spec, wire=wires[who], output=str(folder.rows(who)), inputs=inputs)
    if record:
        specs["recorder"] = RecorderSpec(
            name=design.scenario.name,
            n=design.scenario.plant.n,
            sizes=sizes,
            arcs=tuple((a.source, a.target) for a in design.scenario.graph.arcs),
            step=design.plant.step,
            steps=design.plant.steps,
            recording=str(folder.root / "recording.rrd"),
            live=live,
            description=describe(design.scenario, design.certificate),
            truth=str(folder.rows("plant")),
            estimates={i: str(folder.rows(f"node-{i}")) for i in sorted(design.nodes)},
            unknown_inputs=reconstructs(design)[0],
            flags=any(spec.without for spec in design.nodes.values()),
            watch_step=getattr(design.scenario.options, "watch_step", None),
            outside=design.plant.outside is not None,
            tick=design.plant.tick,
            wire=wires["recorder"],
        )
    return specs


class Launch:
    """One run of a design over Zenoh on this host."""

    def __init__(
        self,
        design: Design,
        folder: RunFolder,
        supervisor: Supervisor,
        *,
        record: bool,
        live: bool,
        address: str = LOOPBACK,
    ) -> None:
        self._design, self._folder, self._supervisor = design, folder, supervisor
        self._record, self._live = record, live
        self._sizes = estimate_sizes(design)
        # made once: the parts of every new path become interned strings, and ten times a second that adds up
        self._truth, self._rows = folder.rows("plant"), {i: folder.rows(f"node-{i}") for i in design.nodes}
        self._url = ""  # of the live server, once the recorder has said it
        self._wiring = Wiring(design, folder.keys, record=record, address=address)

    def go(self, show: Show, watcher: Watcher | None) -> None:
        """Start everybody and stay until plant and nodes are done. Raises RunError, or KeyboardInterrupt."""
        try:
            if not self._design.scenario.security.keep:
                self._supervisor.forget(self._folder.keys)  # before there is anything in it
            run, wires = self._design.scenario.run, self._wiring.wires()
            specs = specs_of(self._design, self._folder, wires, record=self._record, live=self._live)
            for who, spec in specs.items():
                write_spec(spec, self._folder.spec(who))
                self._supervisor.start(who, who.split("-")[0], *self._files(who))

            def replace_node(who: str, before: int) -> None:
                spec = specs[who]
                assert isinstance(spec, NodeSpec)  # noqa: S101
                write_spec(replace(spec, incarnation=before), self._folder.spec(who))
                self._supervisor.replace(who, "node", *self._files(who))

            recover = None
            if run.on_node_loss != "stop":
                recover = Recovery(self._supervisor, run.on_node_loss, replace_node)
            self._supervisor.watch(lambda: self._look(show, watcher), run.deadline, recover, run.max_seconds)
            if self._record:
                if watcher and self._url:
                    watcher.ended(self._url)
                rows = self._design.plant.steps * len(self._sizes)
                self._supervisor.finish("recorder", CLOSING + rows / CLOSING_ROWS)
        finally:
            self._wiring.release()

    def _finished(self, steps: Mapping[int, int]) -> int:
        """Steps that every node has done that is there."""
        processes = self._supervisor.processes
        return min((k for i, k in steps.items() if processes[f"node-{i}"].there), default=0)

    def _files(self, who: str) -> tuple[Path, Path, Path]:
        """A process' spec, log and standard error."""
        return self._folder.spec(who), self._folder.log(who, "jsonl"), self._folder.log(who, "err")

    def _look(self, show: Show, watcher: Watcher | None) -> int:
        """Show the progress; how many bytes all journals have grown to."""
        recorder = self._supervisor.processes.get("recorder")
        if watcher and recorder and not self._url and (url := recorder.said.get("url")):
            self._url = url
            watcher.started(url)
        sizes = {i: path.stat().st_size if path.exists() else 0 for i, path in self._rows.items()}
        steps = {i: size // (8 * self._sizes[i]) for i, size in sizes.items()}
        errors = {}
        n = self._design.scenario.plant.n
        for i, k in steps.items():
            x = _row(self._truth, n, k - 1)
            estimate = _row(self._rows[i], self._sizes[i], k - 1)
            if x is not None and estimate is not None:
                with np.errstate(over="ignore", invalid="ignore"):  # of an unstable plant
                    errors[i] = float(np.sqrt(np.mean((estimate[:n] - x) ** 2)))
        show(Progress(self._finished(steps), errors, self._supervisor.note or self._supervisor.waiting(BRIEF)))
        return sum(sizes.values())


def _row(path: Path, size: int, k: int) -> Array | None:
    """Row k of a journal, or None when it is not there yet."""
    if k < 0 or not path.exists():
        return None
    with path.open("rb") as f:
        f.seek(8 * size * k)
        data = f.read(8 * size)
    return np.frombuffer(data, dtype="<f8") if len(data) == 8 * size else None


def run(
    design: Design,
    out: str | Path | None = None,
    *,
    record: bool = True,
    live: bool = False,
    show: Show = ignore,
    watcher: Watcher | None = None,
    supervisor: Supervisor | None = None,
    address: str = LOOPBACK,
) -> RunResult:
    """Run a design as real processes over Zenoh and gather its results into the run folder.

    ``out``: the folder (default runs/<name>/<UTC time>); ``watcher`` is told where to watch live and
    when the nodes are done; ``supervisor``: one that was started earlier, to save its
    start-up time; ``address``: where the processes listen. Raises RunError when a process is lost or a deadline passes
    (the folder then holds what there is), ScenarioError when they may not listen there.
    """
    scenario = design.scenario
    check_address(address, scenario.security)
    check_files(len(design.nodes))
    with Supervisor() if supervisor is None else contextlib.nullcontext(supervisor) as supervisor:
        folder = RunFolder.create(scenario.name, out)
        write_inputs(folder, design)
        launch = Launch(design, folder, supervisor, record=record, live=live, address=address)
        begin = time.monotonic()
        failed = ""
        try:
            launch.go(show, watcher)
        except RunError as e:
            failed = str(e)
        except KeyboardInterrupt:
            failed = "interrupted"
            raise
        finally:
            with _undisturbed():
                with contextlib.suppress(RunError):  # a nursery that died has taken everybody along
                    supervisor.end()
                if not scenario.security.keep:
                    credentials.remove(folder.keys)
                result = gather(folder, design, supervisor, time.monotonic() - begin, failed)
    if failed:
        raise RunError(f"{failed} (what there is of the run is in {folder.root})", warnings=result.warnings)
    return result


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Whoever presses Ctrl-C twice gets the results of what there is all the same."""
    if threading.current_thread() is not threading.main_thread():  # which alone hears signals
        yield
        return
    before = {
        number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run_in_process(
    design: Design, out: str | Path | None = None, *, record: bool = True, show: Show = ignore
) -> RunResult:
    """The oracle with the same run folder: no processes, no Zenoh. Raises RunError when the folder cannot be used."""
    folder = RunFolder.create(design.scenario.name, out)
    write_inputs(folder, design)
    begin = time.monotonic()
    tally = Tally()
    try:
        trace = simulate(design, lambda steps: show(Progress(steps, {})), tally)
    except BaseException:  # interrupted, for one: then there is nothing to keep
        folder.tidy()
        raise
    took = time.monotonic() - begin
    counts: dict[str, Any] = {
        "rounds": tally.rounds,
        "rounds_per_second": tally.rounds / took,
        "messages": tally.messages,
        "rejected": {},
        "events": [],
        "failure": "",
    }
    if design.scenario.patchy:
        counts["faults"] = {what: tally.faults[what] for what in COUNTED}
    warnings = _flagged(trace)
    if design.scenario.run.inputs:
        warnings += ("run.inputs: a run in one process keeps no tapes; only node processes do",)
    return _finish(folder, design, trace, counts, record=record, warnings=warnings)


def _flagged(trace: Trace) -> tuple[str, ...]:
    """Where messages can be missing, warn of the estimates that their own nodes mark."""
    counts = () if trace.flagged is None else trace.flagged.sum(axis=1).tolist()
    return tuple(
        f"node-{i} flags {count} of its {len(trace.t)} estimates: messages were missing that it needs for them"
        for i, count in zip(trace.node_ids.tolist(), counts, strict=False)
        if count
    )


def write_inputs(folder: RunFolder, design: Design) -> None:
    """scenario.yaml and certificate.json."""
    (folder.root / "scenario.yaml").write_text(resolved(design.scenario), encoding="utf-8")
    (folder.root / "certificate.json").write_text(json.dumps(design.certificate, indent=2) + "\n")


def resolved(scenario: Scenario) -> str:
    """The scenario as a topology file of its own, with the versions that ran it."""
    from duio_mesh import __version__
    from duio_mesh.scenario import scenario_yaml

    return scenario_yaml(scenario, {"duio_mesh": __version__, "numpy": np.__version__})


def gather(folder: RunFolder, design: Design, account: Account, seconds: float, failed: str) -> RunResult:
    """The result from what the processes left; a recorder that was lost is made good from the trace."""
    trace = folder.gather(design)
    said = {who: p.done for who, p in account.processes.items()}
    nodes = [said[f"node-{i}"] for i in design.nodes if said.get(f"node-{i}")]
    rounds = max((node["rounds"] for node in nodes), default=0)
    took = max((node["seconds"] for node in nodes), default=seconds)
    counts: dict[str, Any] = {
        "rounds": rounds,
        "rounds_per_second": rounds / took if took else 0.0,
        "messages": sum(node["frames"] for node in nodes),
        "rejected": {who: p.rejected for who, p in account.processes.items() if p.rejected},
        "events": account.events,
        "failure": failed,
    }
    recorder = account.processes.get("recorder")
    warnings = [f"{p.who}: {text}" for p in account.processes.values() for text in p.warnings]
    warnings += _flagged(trace)
    if design.scenario.patchy:
        counts["faults"] = {what: sum(node["faults"].get(what, 0) for node in nodes) for what in COUNTED}
    if design.scenario.timing.tick:
        counts["timing"] = timeliness(design.scenario, said)
        warnings += untimely(counts["timing"], design.plant.steps)
    if held := said.get("gateway", {}).get("held"):
        counts["held"] = held
        warnings += [f"{key}: {n} samples were late; the last value before was used" for key, n in held.items()]
    lost = recorder is not None and not recorder.done
    if recorder and lost:
        warnings.append(f"{recorder.death()}; the recording was made from the trace instead")
    return _finish(folder, design, trace, counts, record=lost, warnings=tuple(warnings))


def _finish(
    folder: RunFolder,
    design: Design,
    trace: Trace,
    counts: Mapping[str, Any],
    *,
    record: bool,
    warnings: tuple[str, ...] = (),
) -> RunResult:
    """trace.npz, metrics.json and, with ``record``, the recording of a finished trace."""
    write_trace(folder.root / "trace.npz", trace)
    if record:
        from duio_mesh.report.record_trace import record_trace

        page = describe(design.scenario, design.certificate)
        record_trace(folder.root / "recording.rrd", design.scenario, trace, page)
    report = metrics(trace, design.scenario, counts)
    (folder.root / "metrics.json").write_text(json.dumps(report, indent=2) + "\n")
    folder.tidy()
    good = report["agree"] if design.scenario.outside else report["converged"]
    return RunResult(folder.root, trace, report, bool(good), warnings)
