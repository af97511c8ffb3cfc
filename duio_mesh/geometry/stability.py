"""Which eigenvalues count as stable: one explicit region for all users."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.linalg import lapack

from duio_mesh.arrays import Array
from duio_mesh.geometry.subspace import GeometryError

# eigenvalues this close (relative to max(1, |lambda|)) are one cluster: a computed double eigenvalue splits by 1.5e-8
_CLUSTER = 1e-7

SCHUR = 1 - 1e-9
"""What the spectral radius of a finished design has to stay below: rounding prints an eigenvalue 1 as 1 - 1e-16."""


@dataclass(frozen=True)
class Stability:
    """The good part of the complex plane: |lambda| < bound in discrete time, Re lambda < bound in continuous time.

    Make one with ``stable_radius`` or ``stable_abscissa``. The bound carries the margin: an eigenvalue 1 that rounding
    prints as 0.99999 or 1.00003 must fall on a side on purpose.
    """

    time: Literal["discrete", "continuous"]
    bound: float

    def level(self, eigenvalues: Any) -> Array:
        """What is compared with the bound: the modulus or the real part."""
        values = np.asarray(eigenvalues, dtype=np.complex128)
        return np.asarray(np.abs(values) if self.time == "discrete" else values.real)

    def bad(self, eigenvalues: Any) -> NDArray[np.bool_]:
        """Per eigenvalue whether it lies outside the region.

        An eigenvalue next to a bad one (within 1e-7, relative to max(1, |lambda|)) is bad too, so a double eigenvalue
        on the bound is never torn apart. Eigenvalues of multiplicity 3 and more split wider: choose a bound away from
        them.
        """
        values = np.asarray(eigenvalues, dtype=np.complex128)
        bad = self.level(values) >= self.bound
        near = np.abs(values[:, None] - values[None, :]) <= _CLUSTER * np.maximum(1.0, np.abs(values))[:, None]
        near |= near.T
        for _ in range(values.size):
            grown = bad | (near & bad[None, :]).any(axis=1)
            if (grown == bad).all():
                break
            bad = grown
        return np.asarray(bad)

    def stable(self, eigenvalues: Any) -> bool:
        """Whether all of them are good."""
        return not self.bad(eigenvalues).any()

    def __str__(self) -> str:
        return f"{'|lambda|' if self.time == 'discrete' else 'Re lambda'} < {self.bound:.12g}"


def stable_radius(radius: float = 1 - 1e-9) -> Stability:
    """Discrete time: good is |lambda| < radius. Raises GeometryError unless 0 < radius <= 1."""
    if not 0 < radius <= 1:
        raise GeometryError(f"the stable radius must lie in (0, 1], not {radius}")
    return Stability("discrete", float(radius))


def stable_abscissa(abscissa: float = -1e-6) -> Stability:
    """Continuous time: good is Re lambda < abscissa. Raises GeometryError unless abscissa <= 0."""
    if not abscissa <= 0:
        raise GeometryError(f"the stable abscissa must not be positive, not {abscissa}")
    return Stability("continuous", float(abscissa))


def split_spectrum(A: Array, stability: Stability) -> tuple[Array, NDArray[np.complex128], NDArray[np.complex128]]:
    """The invariant subspace of A (k, k) that belongs to its bad eigenvalues, by an ordered real Schur form.

    Returns its orthonormal basis (k, b), the b bad and the k - b good eigenvalues.
    Raises GeometryError when good and bad eigenvalues are too close to be separated.
    """
    if not A.size:
        none = np.zeros(0, dtype=np.complex128)
        return np.zeros((0, 0)), none, none
    T, Z = linalg.schur(A, output="real")
    everything = np.ones(T.shape[0], dtype=np.int32)
    _, _, re, im, *_ = lapack.dtrsen(everything, T, Z, job=b"N")  # moves nothing: eigenvalues in diagonal order
    bad = stability.bad(re + 1j * im)
    _, Z, re, im, _, _, _, info = lapack.dtrsen(bad.astype(np.int32), T, Z, job=b"N")
    if info:
        raise GeometryError(
            f"eigenvalues on the two sides of {stability} are too close to be separated; move the bound"
        )
    b = int(np.count_nonzero(bad))
    values = re + 1j * im
    return Z[:, :b], values[:b], values[b:]


def spectral_radius(M: Array) -> float:
    """The largest modulus of an eigenvalue of M (n, n); 0 when n is 0."""
    return float(np.abs(np.linalg.eigvals(M)).max(initial=0.0))
