"""The folder of one run: who writes which file, and how it becomes a trace.

scenario.yaml  certificate.json  trace.npz  recording.rrd  metrics.json     written by the launcher (and recorder)
nodes/node-3.spec  nodes/plant.spec  nodes/recorder.spec                    what each process was given (mode 0600)
logs/node-3.jsonl  logs/node-3.err                                          events; whatever went to stderr
rows/node-3.f64    rows/plant.f64    rows/node-3.f64.aside                  removed once trace.npz holds them
inputs/node-3.tape                                                          when asked for: see tape.py (mode 0600)
keys/node-3/key.pem  ...                                                    removed at the end (mode 0600 until then)
"""

from __future__ import annotations

import contextlib
import shutil
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain, count
from pathlib import Path

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.journal import aside, map_rows, missing
from duio_mesh.observers.watch import COLUMNS
from duio_mesh.simulation import Trace, estimate_sizes, split_trace
from duio_mesh.synthesis.design import Design


class RunFolder:
    """Paths of one run."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @classmethod
    def create(cls, name: str, out: str | Path | None) -> RunFolder:
        """Make the folder: exactly ``out``, or runs/<name>/<UTC time> with runs/<name>/latest pointing at it.

        Raises RunError when ``out`` already holds something: a run is never overwritten.
        """
        if out is not None:
            root = Path(out)
            check_free(root)
            root.mkdir(parents=True, exist_ok=True)
        else:
            home = Path("runs") / name
            home.mkdir(parents=True, exist_ok=True)
            root = _unused(home / datetime.now(UTC).strftime("%Y-%m-%dT%H-%M-%SZ"))
            _point(home / "latest", root.name)
        folder = cls(root.resolve())
        for sub in ("nodes", "logs", "rows"):
            (folder.root / sub).mkdir()
        return folder

    def spec(self, who: str) -> Path:
        """The spec file of a process."""
        return self.root / "nodes" / f"{who}.spec"

    @property
    def keys(self) -> Path:
        """The credentials of a run that is not open; removed with it unless they are to be kept."""
        return self.root / "keys"

    def rows(self, who: str) -> Path:
        """The journal of a process."""
        return self.root / "rows" / f"{who}.f64"

    def inputs(self, who: str) -> Path:
        """The tape of a node."""
        return self.root / "inputs" / f"{who}.tape"

    def log(self, who: str, kind: str) -> Path:
        """The log (kind ``jsonl``) or standard error (``err``) of a process."""
        return self.root / "logs" / f"{who}.{kind}"

    def gather(self, design: Design) -> Trace:
        """The trace of all rows that were written; what a process never wrote is NaN."""
        sizes = estimate_sizes(design)
        x = map_rows(self.rows("plant"), design.scenario.plant.n)
        rows = {i: map_rows(self.rows(f"node-{i}"), size) for i, size in sizes.items()}
        steps = max(map(len, rows.values()))
        watched = {i: np.array(map_rows(aside(self.rows(f"node-{i}")), COLUMNS)) for i in sizes}
        trace = split_trace(design, _padded(x, steps), {i: _padded(r, steps) for i, r in rows.items()}, watched)
        gaps = {i: np.array(map_rows(missing(self.rows(f"node-{i}")), 1)[:, 0]) for i in sizes if design.plant.tick}
        return replace(trace, samples=self._samples(design, steps), missing=gaps)

    def _samples(self, design: Design, steps: int) -> dict[int, Array]:
        """What a gateway handed on to every node; {} when the plant was simulated."""
        if (outside := design.plant.outside) is None:
            return {}
        widths = outside.widths()
        rows = _padded(map_rows(self.rows("gateway"), sum(widths.values())), steps)
        ends = np.cumsum(list(widths.values()))
        return {i: rows[:, end - width : end] for (i, width), end in zip(widths.items(), ends, strict=True)}

    def tidy(self) -> None:
        """Remove the journals (they are in trace.npz now) and empty files of standard error."""
        shutil.rmtree(self.root / "rows")
        for path in (self.root / "logs").glob("*.err"):
            if path.stat().st_size == 0:
                path.unlink()


def check_free(root: Path) -> None:
    """Raise RunError when there is something already: a run is never overwritten."""
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise RunError(f"{root} already exists and is not an empty folder; choose another --out")


def _unused(path: Path) -> Path:
    """Make the folder ``path``, or path-2, path-3, ... when a run of the same second already has it."""
    for candidate in chain((path,), (path.with_name(f"{path.name}-{n}") for n in count(2))):
        with contextlib.suppress(FileExistsError):
            candidate.mkdir()
            break
    return candidate


def _point(link: Path, target: str) -> None:
    """Make ``link`` a symbolic link to ``target``, replacing an old one in one step."""
    fresh = link.with_name(f".{link.name}-{target}")
    fresh.symlink_to(target)
    fresh.replace(link)


def _padded(rows: Array, steps: int) -> Array:
    """``rows`` cut or filled with NaN to ``steps`` rows."""
    missing = np.full((max(0, steps - len(rows)), rows.shape[1]), np.nan)
    return np.vstack([rows[:steps], missing])
