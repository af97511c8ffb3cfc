"""The rounds of one step, kept to be looked at: how far a fusion has come, round by round."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from duio_mesh.arrays import Array

ROWS = 1000  # rounds of a step that are kept, about: a plot is not wider
COLUMNS = 3  # round, residual, disagreement


class RoundWatch:
    """Called with every round of the watched step; keeps every so many-th, and the last."""

    def __init__(self, rounds: int) -> None:
        """``rounds``: how many there will be."""
        self._last, self._stride = rounds - 1, -(-rounds // ROWS)
        self._rows: list[tuple[float, float, float]] = []

    def __call__(self, r: int, residual: float, disagreement: float) -> None:
        """Round r, and the node's own figures of the iterate that it exchanges."""
        if r % self._stride == 0 or r == self._last:
            self._rows.append((float(r), residual, disagreement))

    def take(self) -> Array:
        """Rows (m, 3) [round, residual, disagreement] since the last call."""
        rows = np.array(self._rows).reshape(-1, COLUMNS)
        self._rows.clear()
        return rows


def watcher(observer: object) -> Callable[[], Array]:
    """What an observer has kept of its rounds since it was last asked; always nothing where it cannot be watched."""
    watched: Callable[[], Array] | None = getattr(observer, "watched", None)
    nothing = np.zeros((0, COLUMNS))
    return watched or (lambda: nothing)
