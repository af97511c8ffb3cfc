"""The sender's part in faults on purpose: it flips the bits that are to be flipped, and sends second copies."""

from __future__ import annotations

from collections.abc import Iterable

from duio_mesh.arrays import Array
from duio_mesh.faults import Edge
from duio_mesh.mesh.session import Outlet
from duio_mesh.spec import NodeSpec


class Spoiler:
    """Sends a node's vectors as its faults have it."""

    def __init__(self, spec: NodeSpec, told: Outlet) -> None:
        self._told, seed = told, spec.faults.seed
        self._out = [Edge(seed, spec.id, j, spec.spoils[j]) if j in spec.spoils else None for j in spec.tells]

    def __call__(self, k: int, r: int, vector: Array) -> None:
        """Send the vector of step k, round r to every neighbour."""
        self._told.send_each(k, r, vector, lambda at, frame: self._spoilt(at, frame, k, r))

    def _spoilt(self, at: int, frame: bytes, k: int, r: int) -> Iterable[bytes]:
        edge = self._out[at]
        if edge is None:
            return (frame,)
        fate = edge.fate(k, r)
        if fate.corrupt:
            flipped = bytearray(frame)
            bit = int(fate.bit * 8 * len(frame))
            flipped[bit // 8] ^= 1 << bit % 8
            frame = bytes(flipped)
        return (frame, frame) if fate.duplicate else (frame,)
