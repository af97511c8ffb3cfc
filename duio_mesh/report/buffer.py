"""Rows that gather until they are worth a send."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array

ROWS = 1 << 15  # of one entity that are sent at once at most
ROOM = 256  # rows for which there is room even where fewer are enough


class Buffer:
    """Rows of some scalar series that share their steps, until there are enough to send.

    It has all its memory from the beginning: a recorder that grew as it gathers could not be told from a leaking one.
    """

    def __init__(self, paths: list[str], enough: int, send: Callable[[str, NDArray[np.int64], Array], None]) -> None:
        self._paths, self._enough, self._send = paths, enough, send
        room = min(ROWS, max(enough, ROOM))
        self._steps: NDArray[np.int64] = np.full(room, 0, dtype=np.int64)
        self._rows: Array = np.full((len(paths), room), 0.0)
        self._count = 0

    def add(self, steps: NDArray[np.int64], rows: Array) -> None:
        """Rows (m, number of paths)."""
        done = 0
        while done < len(steps):
            take = min(len(steps) - done, len(self._steps) - self._count)
            there, here = slice(self._count, self._count + take), slice(done, done + take)
            self._steps[there] = steps[here]
            self._rows[:, there] = rows[here].T
            self._count, done = self._count + take, done + take
            if self._count == len(self._steps):
                self.flush(everything=True)

    def flush(self, *, everything: bool = False) -> None:
        """Send what there is, if it is enough or in any case."""
        if not self._count or not (everything or self._count >= self._enough):
            return
        count, self._count = self._count, 0
        steps = self._steps[:count].copy()
        for path, values in zip(self._paths, self._rows, strict=True):
            self._send(path, steps, values[:count].copy())
