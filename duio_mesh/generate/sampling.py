"""From dx/dt = A x + B u to exact samples."""

from __future__ import annotations

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array


def zero_order_hold(A: Array, B: Array, step: float) -> tuple[Array, Array]:
    """(A_d, B_d) of x(t + step) for u constant over the step: the blocks of expm([[A, B], [0, 0]] step)."""
    n, m = B.shape
    block = linalg.expm(step * np.block([[A, B], [np.zeros((m, n + m))]]))
    return block[:n, :n].copy(), block[:n, n:].copy()
