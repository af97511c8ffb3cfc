"""How many neighbours each node went on without, step by step, in a recording of a run on the wall clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.report.buffer import Buffer
from duio_mesh.report.entities import Entities
from duio_mesh.report.pairing import Spans

ENOUGH = 64  # rows that are worth a send


class Gaps:
    """One line per node; of a stretch of equal counts its ends."""

    def __init__(self, entities: Entities, send: Callable[[str, NDArray[np.int64], Array], None]) -> None:
        """``send(path, steps, values)`` writes into the recording."""
        self._seen = {i: Spans() for i in entities.ids}
        self.buffers = {i: Buffer([entities.gap(i)], ENOUGH, send) for i in entities.ids}

    def rows(self, node: int, k: int, counts: Array) -> None:
        """Counts (m,) of the steps from k on; steps that are known already are passed over."""
        for first, last in self._seen[node].gaps(k, k + len(counts)):
            new = counts[first - k : last - k]
            changed = new[1:] != new[:-1]
            keep = np.append(True, changed) | np.append(changed, True)
            self.buffers[node].add(np.arange(first, last)[keep], np.ascontiguousarray(new[keep, None]))
        self._seen[node].add(k, k + len(counts))
