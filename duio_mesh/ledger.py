"""Rows that came over the network, each at its place in a journal file: for a recorder whose run has no shared disk."""

from __future__ import annotations

import os
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from duio_mesh.journal import ASIDE, MISSING, aside, missing
from duio_mesh.spec import RecorderSpec

if TYPE_CHECKING:  # the launcher knows journals and must not load Zenoh
    from duio_mesh.mesh import Frame


class Ledger:
    """Writes the journals of other processes from the batches that they send; a row that never came is NaN.

    It also knows who is there: a recorder that no launcher ends leaves when nobody is left.
    """

    def __init__(self, spec: RecorderSpec) -> None:
        self._paths = {"plant": spec.truth} | {f"node-{i}": path for i, path in spec.estimates.items()}
        self._sizes = {"plant": spec.n} | {f"node-{i}": size for i, size in spec.sizes.items()}
        self._open = ExitStack()
        self._files = {
            who: self._open.enter_context(Path(path).open("wb"))  # noqa: SIM115  (closed with the stack)
            for who, path in self._paths.items()
        }
        self._rows = dict.fromkeys(self._paths, 0)  # of each journal, from its beginning
        self._came = Counter[str]()
        self._steps = spec.steps
        self._awaited, self._here = {*self._paths}, set[str]()
        self._until = time.monotonic() + spec.wire.start

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._open.close()

    def take(self, who: str, frame: Frame) -> None:
        """Write down what a frame holds."""
        data = frame.vector.astype("<f8", copy=False).tobytes()
        if who != "plant" and frame.r in (ASIDE, MISSING):
            beside = (aside if frame.r == ASIDE else missing)(self._paths[who])
            with beside.open("ab") as file:
                file.write(data)
            return
        file, size, end = self._files[who], self._sizes[who], self._rows[who]
        if frame.k > end:
            os.pwrite(file.fileno(), np.full((frame.k - end) * size, np.nan).tobytes(), 8 * size * end)
        os.pwrite(file.fileno(), data, 8 * size * frame.k)
        count = frame.vector.size // size
        self._rows[who] = max(end, frame.k + count)
        self._came[who] += count

    def changed(self, who: str, alive: bool) -> None:
        """A process came or went."""
        if who in self._paths:
            self._awaited.discard(who)
            (self._here.add if alive else self._here.discard)(who)

    def over(self) -> bool:
        """Whether all have come and gone, or nobody is here and the time to come is over."""
        return not self._here and (not self._awaited or time.monotonic() > self._until)

    def missing(self) -> dict[str, int]:
        """How many rows of whom have not come."""
        return {who: lack for who in self._paths if (lack := self._steps - self._came[who]) > 0}
