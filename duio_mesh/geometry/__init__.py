"""Subspace algebra for observers with unknown inputs: numpy and scipy.linalg only.

Start with ``observability_decomposition`` and ``detectability_decomposition`` (staircase),
``unknown_input_structure`` (invariant) and ``reduced_observer`` (injection).
"""

from duio_mesh.geometry.stability import Stability, split_spectrum, stable_abscissa, stable_radius
from duio_mesh.geometry.staircase import (
    Decomposition,
    detectability_decomposition,
    observability_decomposition,
    unobservable_subspace,
)
from duio_mesh.geometry.subspace import (
    RTOL,
    GeometryError,
    Rank,
    add,
    complement,
    contains,
    excess,
    gap,
    image,
    intersection,
    kernel,
    orth,
    preimage,
    quotient,
    rank,
)

__all__ = [
    "RTOL",
    "Decomposition",
    "GeometryError",
    "Rank",
    "Stability",
    "add",
    "complement",
    "contains",
    "detectability_decomposition",
    "excess",
    "gap",
    "image",
    "intersection",
    "kernel",
    "observability_decomposition",
    "orth",
    "preimage",
    "quotient",
    "rank",
    "split_spectrum",
    "stable_abscissa",
    "stable_radius",
    "unobservable_subspace",
]
