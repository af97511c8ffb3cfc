"""Subspace algebra for observers with unknown inputs: numpy and scipy.linalg only.

Start with ``observability_decomposition`` and ``detectability_decomposition`` (staircase),
``unknown_input_structure`` (invariant) and ``reduced_observer`` (injection).
"""

from duio_mesh.geometry.injection import MAX_GAIN, ReducedObserver, place, reduced_observer, stabilise
from duio_mesh.geometry.invariant import (
    InputStructure,
    friend,
    infimal_invariant,
    infimal_unobservability,
    unknown_input_structure,
)
from duio_mesh.geometry.stability import Stability, spectral_radius, split_spectrum, stable_abscissa, stable_radius
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
    "MAX_GAIN",
    "RTOL",
    "Decomposition",
    "GeometryError",
    "InputStructure",
    "Rank",
    "ReducedObserver",
    "Stability",
    "add",
    "complement",
    "contains",
    "detectability_decomposition",
    "excess",
    "friend",
    "gap",
    "image",
    "infimal_invariant",
    "infimal_unobservability",
    "intersection",
    "kernel",
    "observability_decomposition",
    "orth",
    "place",
    "preimage",
    "quotient",
    "rank",
    "reduced_observer",
    "spectral_radius",
    "split_spectrum",
    "stabilise",
    "stable_abscissa",
    "stable_radius",
    "unknown_input_structure",
    "unobservable_subspace",
]
