"""Rows that gather until they are worth a send."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array

ROWS = 1 << 15  # of one entity that are sent at once at most


class Buffer:
    """Rows of some scalar series that share their steps, until there are enough to send."""

    def __init__(self, paths: list[str], enough: int, send: Callable[[str, NDArray[np.int64], Array], None]) -> None:
        self._paths, self._enough, self._send = paths, enough, send
        self._steps: list[NDArray[np.int64]] = []
        self._rows: list[Array] = []
        self._count = 0

    def add(self, steps: NDArray[np.int64], rows: Array) -> None:
        """Rows (m, number of paths); the caller gives them away."""
        if not len(steps):
            return
        self._steps.append(steps)
        self._rows.append(rows)
        self._count += len(steps)
        if self._count >= ROWS:
            self.flush(everything=True)

    def flush(self, *, everything: bool = False) -> None:
        """Send what there is, if it is enough or in any case."""
        if not self._count or not (everything or self._count >= self._enough):
            return
        steps, rows = np.concatenate(self._steps), np.concatenate(self._rows)
        self._steps, self._rows, self._count = [], [], 0
        for first in range(0, len(steps), ROWS):
            part = slice(first, first + ROWS)
            for at, path in enumerate(self._paths):
                self._send(path, steps[part], np.ascontiguousarray(rows[part, at]))
