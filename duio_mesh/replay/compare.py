"""What the run itself left of a node's estimates, and where a replay differs from it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.journal import map_rows
from duio_mesh.observers.base import Estimate
from duio_mesh.report.trace_file import read_trace

NAMES = {"state": "x-hat", "unknown_input": "w-hat", "noise": "v-hat", "flag": "flag"}


class Kept(NamedTuple):
    """The rows that there are of one node; NaN where a process was lost."""

    source: str  # the file's name
    parts: Mapping[str, Array]  # (K, size) for each field of Estimate
    truth: Array | None  # (K, n)

    def row(self, k: int) -> dict[str, Array] | None:
        """What the run has for step k, or None."""
        state = self.parts["state"]
        if k >= len(state) or bool(np.isnan(state[k]).all()):
            return None
        return {name: rows[k] for name, rows in self.parts.items()}

    @property
    def last(self) -> int:
        """The last step of which there is a row; -1 when there is none."""
        there = np.flatnonzero(~np.isnan(self.parts["state"]).all(axis=1))
        return int(there[-1]) if len(there) else -1


def kept(folder: Path, node: int, sizes: Estimate) -> Kept | None:
    """What the run folder has of this node: trace.npz, else (the launcher was killed) the node's own rows, else None.

    ``sizes``: an estimate with the right sizes. Raises ValueError when trace.npz is damaged or does not fit, OSError.
    """
    path, rows = folder / "trace.npz", folder / "rows" / f"node-{node}.f64"
    if path.exists():
        trace = read_trace(path)
        at = {int(i): k for k, i in enumerate(trace.node_ids)}.get(node)
        if at is None:
            raise ValueError(f"{path} has no node {node}")
        none = np.zeros((len(trace.t), 0))
        what = none if trace.what is None else trace.what[at]
        flag = none if trace.flagged is None else trace.flagged[at, :, None].astype(np.float64)
        parts = {"state": trace.xhat[at], "unknown_input": what, "noise": trace.vhat.get(node, none), "flag": flag}
        wrong = [name for name, part in sizes._asdict().items() if parts[name].shape[1] != part.size]
        if wrong:
            raise ValueError(f"{path} does not fit the spec of node {node}: {NAMES[wrong[0]]} has another size")
        return Kept(path.name, parts, trace.x)
    if rows.exists():
        whole = np.array(map_rows(rows, sum(part.size for part in sizes)))
        cuts = np.cumsum([part.size for part in sizes[:-1]])
        return Kept(f"rows/{rows.name}", dict(zip(Estimate._fields, np.split(whole, cuts, axis=1), strict=True)), None)
    return None


class Difference(NamedTuple):
    """One number that is not the same."""

    k: int
    name: str  # x-hat3: the third state
    run: float
    replay: float


def difference(k: int, row: Mapping[str, Array], estimate: Estimate) -> Difference | None:
    """The first number of step k whose bits differ."""
    for part, replayed in estimate._asdict().items():
        ran = np.ascontiguousarray(row[part])
        apart = np.flatnonzero(ran.view(np.uint64) != np.ascontiguousarray(replayed).view(np.uint64))
        if len(apart):
            at = int(apart[0])
            return Difference(k, f"{NAMES[part]}{at + 1}", float(ran[at]), float(replayed[at]))
    return None
