"""A run as arrays: what trace.npz holds (``report/trace_file.py`` reads and writes it)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array


@dataclass(frozen=True)
class Trace:
    """A run as arrays: what trace.npz holds. Rows that a lost process never wrote are NaN."""

    t: Array  # (K,) seconds
    x: Array  # (K, n) the truth
    node_ids: NDArray[np.int64]  # (N,)
    xhat: Array  # (N, K, n), xhat[i, k] estimates x[k]
    what: Array | None = None  # (N, K, q) where the method reconstructs the unknown input
    vhat: dict[int, Array] = field(default_factory=dict)  # node id -> (K, r) where it reconstructs its noise
    rounds: dict[int, Array] = field(default_factory=dict)
    """Node id -> (m, 3) [round, residual, disagreement] of a watched step; for the recording, not in trace.npz."""
    missing: dict[int, Array] = field(default_factory=dict)
    """Node id -> (m,) how many neighbours it went on without, in real time; for the recording, not in trace.npz."""
    samples: dict[int, Array] = field(default_factory=dict)
    """Node id -> (K, p + m) [y_i; u_i] as they came from outside; {} when the plant was simulated."""
    flagged: NDArray[np.bool_] | None = None
    """(N, K) estimates that the node itself marks as not to be trusted; None where no message can be missing."""

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(N, K) steps of which a node has no estimate, in a run that goes on without it.

        There are none where no message can be missing: such a run ends with its first loss. An estimate that has left
        the floats is NaN too, but it is one, and it is flagged.
        """
        if self.flagged is None:
            return np.zeros(self.xhat.shape[:2], dtype=bool)
        return np.asarray(np.isnan(self.xhat).all(axis=2) & ~self.flagged)

    def arrays(self) -> dict[str, NDArray[np.generic]]:
        """The arrays under the names of trace.npz."""
        named: dict[str, NDArray[np.generic]] = {"t": self.t, "x": self.x, "node_ids": self.node_ids, "xhat": self.xhat}
        if self.what is not None:
            named["what"] = self.what
        if self.flagged is not None:
            named["flagged"] = self.flagged
        named |= {f"vhat_{i}": v for i, v in self.vhat.items()}
        return named | {f"sample_{i}": s for i, s in self.samples.items()}
