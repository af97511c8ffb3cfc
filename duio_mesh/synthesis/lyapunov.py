"""Discrete Lyapunov equations, for what several methods ask of their error matrices."""

from __future__ import annotations

import numpy as np

from duio_mesh.arrays import Array


def gramians(Phi: Array, W: Array, Q: Array) -> tuple[Array, Array] | None:
    """X = Phi X Phi' + W and Y = Phi' Y Phi + Q by doubling; None when Phi is not Schur."""
    X, Y, power = W, Q, Phi
    for _ in range(45):
        X = X + power @ X @ power.T
        Y = Y + power.T @ Y @ power
        power = power @ power
        size = np.abs(power).max()
        if not size < 1e15:
            return None
        if size < 1e-10:
            return X, Y
    return None
