"""One node of the LMI observer (seed 000, Algorithm 1).

    x-hat = xi - E y                                                                        (17)
    xi+   = N xi + L y + M u - G sum_j a_ij (x-hat - x-hat_j)                               (16)

with N = P A - K C and M = P B_i. The paper lists "collect the neighbours' x-hat" first and "transmit" last; taken
literally, every node waits for all others. In order: y(k) gives x-hat(k), which is sent; with the neighbours' x-hat(k)
and u(k) follows xi(k+1). A neighbour that is not heard in a step is left out of the sum: a stale x-hat would pull to
where the plant was.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duio_mesh.arrays import Array, contiguous
from duio_mesh.observers.base import Estimate
from duio_mesh.spec import NodeSpec


class Observer:
    """The step machine; ``spec.matrices`` holds N (n, n), L (n, p), M (n, m), E (n, p), G (n, n)."""

    rounds = 1

    def __init__(self, spec: NodeSpec) -> None:
        n, p, m = spec.n, spec.p, spec.m
        N, L, M, E, G = (spec.matrices[name] for name in "NLMEG")
        # one product per step: xi+ = step @ [xi; y; u; x-hat - x-hat_j for each neighbour j]
        self._step = contiguous(np.hstack([N, L, M, *(-weight * G for weight in spec.hears.values())]))
        self._data = np.zeros(self._step.shape[1])
        self._xi, self._y, self._u, apart = np.split(self._data, [n, n + p, n + p + m])
        self._apart = dict(zip(spec.hears, apart.reshape(-1, n), strict=True))
        self._E, self._xhat, self._next = E, np.zeros(n), np.zeros(n)

    def sample(self, y: Array, u: Array) -> None:
        """x-hat(k) = xi(k) - E y(k)  (17)."""
        self._y[:], self._u[:] = y, u
        np.dot(self._E, self._y, out=self._xhat)
        np.subtract(self._xi, self._xhat, out=self._xhat)

    def message(self, r: int) -> Array:
        """x-hat(k)."""
        return self._xhat

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """xi(k+1) from the neighbours' x-hat(k)  (16)."""
        for j, apart in self._apart.items():
            if j in received:
                np.subtract(self._xhat, received[j], out=apart)
            else:
                apart.fill(0.0)
        np.dot(self._step, self._data, out=self._next)
        self._xi[:] = self._next

    def estimate(self) -> Estimate:
        """x-hat(k)."""
        return Estimate(self._xhat.copy())
