"""Levant's first-order differentiator in implicit Euler form: exact in closed form, and it does not chatter."""

from __future__ import annotations

import numpy as np

from duio_mesh.arrays import Array


class Differentiator:
    """dz0/dt = -l0 |z0 - a|^(1/2) sgn(z0 - a) + z1, dz1/dt = -l1 sgn(z0 - a), per component (seed 004, (25)).

    One implicit step solves e + h l0 |e|^(1/2) sgn(e) + h^2 l1 sgn(e) = b for the new e = z0 - a, sgn set-valued at 0.
    Explicit Euler chatters with an amplitude that grows with l1; here e = 0 while sliding, and then z1 is the backward
    difference of a. A corner of a is followed at the slope l1.
    """

    def __init__(self, start: Array, h: float, l0: float, l1: float) -> None:
        self._h, self._l0, self._l1 = h, l0, l1
        self._z0 = start.copy()
        self.rate = np.zeros_like(start)

    def push(self, a: Array) -> Array:
        """The derivative after the next sample a (q,)."""
        h, l0, l1 = self._h, self._l0, self._l1
        b = self._z0 + h * self.rate - a
        far = np.maximum(np.abs(b) - h * h * l1, 0.0)
        root = (np.sqrt((h * l0) ** 2 + 4 * far) - h * l0) / 2  # |e|^(1/2)
        self.rate = self.rate - np.clip(b / h, -h * l1, h * l1)
        self._z0 = a + np.sign(b) * root**2
        return self.rate
