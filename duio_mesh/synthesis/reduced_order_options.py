"""What may stand under ``observer:`` for ``method: reduced_order``."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.synthesis.sampled import HoldOptions


class Options(HoldOptions):
    """The keys under ``observer:`` for ``method: reduced_order``."""

    c: PositiveFloat | Literal["auto"] = "auto"
    """Coupling gain, 1/s. ``auto``: the smallest one whose sampled error decays about as fast as any."""
    sigma: NonNegativeFloat | Literal["auto"] = "auto"
    """1/s. Invisible modes with Re >= -sigma are left to the network (0: the paper). ``auto``: 0.5, or 0 if need be."""
    rate: PositiveFloat | Literal["auto"] = "auto"
    """1/s. Visible modes are moved left of -rate. ``auto``: 3, halved until reliable gains exist."""
    kappa: PositiveFloat = 5.0
    """1/s. M = -kappa I of the interval observer; larger amplifies state errors in the unknown input."""
    bounds: tuple[tuple[float, float], ...] | None = None
    """[low, high] of each unknown input, default [-5, 5]. Only a scale: leaving them costs no accuracy."""
    lipschitz: PositiveFloat = 50.0
    """1/s^2. Bound on the second derivative of alpha. A step of f takes up to about kappa/lipschitz s."""


def bounds_of(options: Options, q: int) -> tuple[Array, Array]:
    """The lowest and highest value (q,) of each unknown input. Raises DesignError when they are not as many."""
    bounds = options.bounds or ((-5.0, 5.0),) * q
    if len(bounds) != q or any(low >= high for low, high in bounds):
        raise DesignError(f"observer.bounds: one [low, high] with low < high for each of the {q} unknown inputs")
    low, high = np.array(bounds).reshape(q, 2).T
    return low, high
