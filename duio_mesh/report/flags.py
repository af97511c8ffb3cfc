"""Estimates that their own nodes mark as not to be trusted, as lanes of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.report import blueprint as look
from duio_mesh.report.entities import FLAGS, Entities
from duio_mesh.report.pairing import runs

TRUSTED, FLAGGED, NONE = FLAGS


class Flags:
    """Turns marks into changes of a lane; rows may come in any order, each once."""

    def __init__(self, entities: Entities, send: Callable[[str, Sequence[int], Any], None]) -> None:
        """``send(path, steps, columns)`` writes into the recording."""
        self._entities, self._send = entities, send
        self._newest: dict[int, tuple[int, str]] = {}  # node -> (step after its last rows, how those were)

    def rows(self, node: int, k: int, marks: Array) -> None:
        """Marks (m,) of the steps from k on that are new: not 0 is flagged."""
        bad = marks != 0
        changes = {k + first: FLAGGED for first, _ in runs(np.flatnonzero(bad))}
        changes |= {k + first: TRUSTED for first, _ in runs(np.flatnonzero(~bad))}
        if self._newest.get(node) == (k, changes[k]):  # goes on as it was
            del changes[k]
        self._newest[node] = (k + len(marks), FLAGGED if bad[-1] else TRUSTED)
        self._log(node, changes)

    def gaps(self, node: int, steps: Iterable[int]) -> None:
        """Steps from which on there are no rows until the next; to be called once, at the end."""
        self._log(node, dict.fromkeys(steps, NONE))

    def _log(self, node: int, changes: dict[int, str]) -> None:
        if changes:
            steps = sorted(changes)
            self._send(self._entities.flag(node), steps, look.states([changes[k] for k in steps]))
