"""What the processes of many hosts wrote -> the results of a run, as a run on one host leaves them."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from duio_mesh import launcher
from duio_mesh.arrays import Array
from duio_mesh.deploy.logs import Logs
from duio_mesh.deploy.stored import read_design, write_design
from duio_mesh.errors import RunError, ScenarioError
from duio_mesh.journal import aside, map_rows, missing
from duio_mesh.launcher import RunResult
from duio_mesh.run_folder import RunFolder, check_free
from duio_mesh.simulation import estimate_sizes
from duio_mesh.synthesis.design import Design

BESIDE = (lambda path: path, aside, missing)


def gather(root: Path, sources: Sequence[Path], out: Path | None) -> tuple[Design, RunResult]:
    """The results of the run whose design is in ``root``, from all journals and logs below ``sources``.

    They are written to ``out``, by default into ``root`` itself. A process' own journal and what the recorder wrote
    down of it may both be there: the longer one counts, and they must not contradict each other. Raises ScenarioError
    when there is no design, no such folder, or there are results already, RunError when there is nothing to gather,
    when two journals contradict each other, or when a process failed (the results are then written all the same).
    """
    design = read_design(root)
    if out is not None:
        check_free(out)
    elif (root / "trace.npz").exists():
        raise ScenarioError([f"{root} holds results already; say where these shall go: --out DIR"])
    if nowhere := [str(source) for source in sources if not source.is_dir()]:
        raise ScenarioError([f"{', '.join(nowhere)}: no such folder"])
    found = [path for source in sources for path in sorted(source.rglob("*")) if path.is_file()]
    sizes = {"plant": design.scenario.plant.n} | {f"node-{i}": size for i, size in estimate_sizes(design).items()}
    if not any(path.name == f"{who}.f64" for path in found for who in sizes):
        raise RunError(f"nothing to gather: no journal (plant.f64, node-*.f64) below {', '.join(map(str, sources))}")
    if out is not None:
        root = write_design(design, out)
    folder = RunFolder(root.resolve())
    folder.rows("plant").parent.mkdir(exist_ok=True)
    logs = Logs()
    shortfall = []
    for who, size in sizes.items():
        rows = _rows(who, size, [path for path in found if path.name == f"{who}.f64"], folder)
        if rows < design.plant.steps:
            shortfall.append(f"{design.plant.steps - rows} of the {design.plant.steps} rows of {who} are not there")
    for path in found:
        if path.suffix == ".jsonl" and (path.stem in sizes or path.stem == "recorder"):
            _log(logs, path, folder)
    recorder = logs.processes.pop("recorder", None)
    recording = next((path for path in found if path.name == "recording.rrd"), None)
    if recorder and not recorder.done:  # when it was killed it could not say so itself
        shortfall.append("the recorder did not end well; the recording was made from the rows")
    elif recorder and recording and not shortfall:
        logs.processes["recorder"] = recorder
        shutil.copyfile(recording, folder.root / "recording.rrd")
    failures = [f"{p.who}: {p.failure}" for p in logs.processes.values() if p.failure]
    result = launcher.gather(folder, design, logs, 0.0, "; ".join(failures))
    if not (folder.root / "recording.rrd").exists():
        from duio_mesh.report.description import describe
        from duio_mesh.report.record_trace import record_trace

        page = describe(design.scenario, design.certificate)
        record_trace(folder.root / "recording.rrd", design.scenario, result.trace, page)
    if failures:
        raise RunError(f"{'; '.join(failures)} (what there is of the run is in {folder.root})")
    return design, replace(result, warnings=(*result.warnings, *shortfall))


def _rows(who: str, size: int, journals: list[Path], folder: RunFolder) -> int:
    """Take the journal of a process with the most rows; how many."""
    if not journals:
        return 0
    best: Path | None = None
    most = np.zeros((0, size))
    for path in journals:
        rows = map_rows(path, size)
        common = min(len(rows), len(most))
        there = ~(np.isnan(rows[:common]).any(axis=1) | np.isnan(most[:common]).any(axis=1))
        if rows[:common][there].tobytes() != most[:common][there].tobytes():
            raise RunError(f"{path} and {best} hold different rows of {who}: are they of the same run?")
        if best is None or _whole(rows) > _whole(most):
            best, most = path, rows
    assert best is not None  # noqa: S101
    for kind in BESIDE:
        if kind(best).exists():
            shutil.copyfile(kind(best), kind(folder.rows(who)))
    return _whole(most)


def _whole(rows: Array) -> int:
    return int(len(rows) - np.isnan(rows).any(axis=1).sum())


def _log(logs: Logs, path: Path, folder: RunFolder) -> None:
    try:
        logs.read(path.stem, path)
    except ValueError as e:
        raise RunError(str(e)) from None
    folder.log(path.stem, "jsonl").parent.mkdir(exist_ok=True)
    shutil.copyfile(path, folder.log(path.stem, "jsonl"))
