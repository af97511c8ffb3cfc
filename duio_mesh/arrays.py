"""The one array type of the project: float64, C-contiguous where it enters a spec (see ``contiguous``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


def contiguous(a: Sequence[Any] | Array) -> Array:
    """A C-contiguous float64 copy.

    Gains that are views or Fortran-ordered round differently in a matrix-vector product than the copy that a node
    process reads from its spec file; one layout everywhere is what makes the mesh equal the oracle bit for bit.
    """
    return np.array(a, dtype=np.float64, order="C")
