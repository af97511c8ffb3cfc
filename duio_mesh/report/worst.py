"""Which of many nodes are worth a look: those with the largest errors at the end of a run."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from duio_mesh.report.pairing import Errors

TAIL = 0.1  # of the run, at its end, that is judged


class Worst:
    """Keeps the largest error norm of every node over the last tenth of a run."""

    def __init__(self, ids: Iterable[int], steps: int) -> None:
        self._from = steps - max(1, round(TAIL * steps))
        self._largest = dict.fromkeys(ids, -np.inf)  # log10

    def see(self, errors: Errors) -> None:
        """Take note of new error norms; one that is not a number is beyond all others."""
        tail = errors.log10[errors.steps >= self._from]
        if len(tail):
            largest = float(np.max(np.nan_to_num(tail, nan=np.inf)))
            self._largest[errors.node] = max(self._largest[errors.node], largest)

    def nodes(self, count: int) -> tuple[int, ...]:
        """The worst so many, ascending by id. A node of which nothing came is worse than all others."""
        never = -np.inf
        ranked = sorted(self._largest, key=lambda i: np.inf if self._largest[i] == never else self._largest[i])
        return tuple(sorted(ranked[-count:]))
