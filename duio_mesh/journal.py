"""A process' own rows (estimates, or true states): to its file always, to the recorder when there is one."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from duio_mesh.arrays import Array

if TYPE_CHECKING:  # the launcher reads journals and must not load Zenoh
    from duio_mesh.mesh import Outlet

PERIOD = 0.1  # seconds between batches: soon enough for the eye, and cheap
BATCH_BYTES = 1 << 16
ASIDE = 1  # the round of a frame that holds other rows than the journal's
MISSING = 2  # ... and of one that says, step by step, how many neighbours were missing


class Journal:
    """Collects rows of ``size`` float64 and passes them on in batches: appended to ``path``, sent on ``outlet``.

    The file is what a run's trace is made of; the network only shows it sooner. So the outlet may drop a batch, and a
    recorder that is slow, frozen or dead costs nothing.
    """

    def __init__(self, path: str, size: int, outlet: Outlet, first: int = 0, kind: int = 0) -> None:
        """``first``: the step of the first row; earlier ones that the file does not hold become NaN.

        ``kind``: the round of the frames that carry these rows.
        """
        if path and first:
            _fill(Path(path), size, first)
        self._kind = kind
        self._file = Path(path).open("ab") if path else None  # noqa: SIM115  (closed in __exit__)
        self._outlet = outlet
        self._rows = np.empty((max(1, BATCH_BYTES // (8 * max(1, size))), size))
        self._filled, self._first = 0, first
        self._due = time.monotonic() + PERIOD

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.flush()
        if self._file:
            self._file.close()

    def add(self, parts: Sequence[Array]) -> None:
        """Append one row, given as its consecutive parts."""
        row = self._rows[self._filled]
        if parts[0].size == row.size:  # a state alone, as nearly always
            row[:] = parts[0]
        else:
            np.concatenate(parts, out=row)
        self._filled += 1
        if self._filled == len(self._rows) or time.monotonic() >= self._due:
            self.flush()

    def aside(self, k: int, rows: Array) -> None:
        """Pass on other rows, which belong to step k: to a file beside, and marked as ``ASIDE`` on the outlet."""
        if self._file:
            aside(self._file.name).write_bytes(rows.astype("<f8", copy=False).tobytes())
        self._outlet.send(k, ASIDE, rows)

    def flush(self) -> None:
        """Pass on what is there."""
        self._due = time.monotonic() + PERIOD
        if not self._filled:
            return
        first, rows = self._first, self._rows[: self._filled]
        # before the rest: whoever stops us in it shall not pass the same rows on once more
        self._first, self._filled = first + self._filled, 0
        if self._file:
            self._file.write(rows.astype("<f8", copy=False).tobytes())
            self._file.flush()
        self._outlet.send(first, self._kind, rows)


def _fill(path: Path, size: int, rows: int) -> None:
    """Make the journal of a lost process ``rows`` long."""
    with path.open("ab") as f:
        whole = f.tell() // (8 * size)
        f.truncate(8 * size * whole)
        f.write(np.full((rows - whole) * size, np.nan, dtype="<f8").tobytes())


def aside(path: str | Path) -> Path:
    """Where the journal ``path`` has its rows of another kind."""
    return Path(f"{path}.aside")


def missing(path: str | Path) -> Path:
    """Where a node with the journal ``path`` says how many neighbours were missing: rows of one number."""
    return Path(f"{path}.missing")


def map_rows(path: str | Path, size: int) -> Array:
    """The whole rows (K, size) of a journal file, mapped rather than read.

    A row that was cut short by a crash is left out; no file is no rows.
    """
    file = Path(path)
    count = file.stat().st_size // (8 * size) if file.exists() else 0
    return np.memmap(file, dtype="<f8", mode="r", shape=(count, size)) if count else np.zeros((0, size))
