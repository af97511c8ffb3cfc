"""Exactly (k, r) from exactly this neighbour, or a clear end.

A neighbour can be at most one round ahead of a node, because its next round needs that node's present one. So two
waiting frames per edge are all that can be right, and whatever does not fit into that is refused.
"""

from __future__ import annotations

from queue import Empty

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.mesh.frames import Frame
from duio_mesh.mesh.session import Mesh, Source


class Lockstep:
    """Takes frames in order from the sources of one mesh."""

    def __init__(self, mesh: Mesh, deadline: float) -> None:
        """``deadline``: seconds that any one wait may last."""
        self._mesh, self._deadline = mesh, deadline

    def take(self, source: Source, k: int, r: int, size: int) -> Array:
        """The vector (size,) of step k, round r from this source, waiting for it if need be.

        Raises RunError naming edge, step and round when it does not come before the deadline, or when the other side
        has gone.
        """
        while True:
            vector = source.waiting.pop((k, r), None)
            if vector is None:
                self._more(source, k, r)
            elif vector.size != size:
                self._mesh.reject(source, f"{vector.size} numbers instead of {size}")
            else:
                source.taken = (k, r)
                return vector

    def _more(self, source: Source, k: int, r: int) -> None:
        if source.gone and not self._mesh.pending():
            raise RunError(f"{self._mesh.who} lost {source.who} while waiting on {source.name} for step {k}, round {r}")
        try:
            got = self._mesh.get(self._deadline)
        except Empty:
            waited = f"{self._mesh.who} waited {self._deadline:g} s on {source.name} for step {k}, round {r}"
            raise RunError(f"{waited}: {source.doing()}") from None
        if got:
            self._keep(*got)

    def _keep(self, source: Source, frame: Frame) -> None:
        k, r, vector = frame
        step, turn = source.taken
        if (k, r) <= (step, turn) or (k, r) in source.waiting:
            self._mesh.reject(source, "seen before")
        elif k - step > source.ahead or r - (turn if k == step else -1) > 2:
            self._mesh.reject(source, "too far ahead")
        else:
            source.waiting[k, r] = vector
