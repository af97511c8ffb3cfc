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
        n = spec.n
        N, L, M, E, G = (spec.matrices[name] for name in "NLMEG")
        # one product per step: xi+ = step @ [xi; y; u; x-hat - x-hat_j for each neighbour j], and one for x-hat
        self._step = contiguous(np.hstack([N, L, M, *(-weight * G for weight in spec.hears.values())]))
        self._look = contiguous(np.hstack([np.eye(n), -E]))
        self._now, self._then = (_Page(spec, self._step.shape[1]) for _ in range(2))
        self._xhat = np.zeros(n)

    def sample(self, y: Array, u: Array) -> None:
        """x-hat(k) = xi(k) - E y(k)  (17)."""
        now = self._now
        now.y[:] = y
        now.u[:] = u
        np.dot(self._look, now.xi_y, out=self._xhat)

    def message(self, r: int) -> Array:
        """x-hat(k)."""
        return self._xhat

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """xi(k+1) from the neighbours' x-hat(k)  (16)."""
        now, then = self._now, self._then
        for j, apart in now.apart:
            if j in received:
                np.subtract(self._xhat, received[j], out=apart)
            else:
                apart.fill(0.0)
        np.dot(self._step, now.data, out=then.xi)
        self._now, self._then = then, now

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """xi from x-hat by (17), then a step without neighbours."""
        now = self._now
        now.xi[:] = 0.0
        now.y[:] = y
        now.xi[:] = x - self._look @ now.xi_y
        self.sample(y, u)
        self.exchange(0, {})

    def estimate(self) -> Estimate:
        """x-hat(k)."""
        return Estimate(self._xhat.copy())


class _Page:
    """[xi; y; u; x-hat - x-hat_j, ...] of one step, and its parts.

    Two take turns, because a product cannot overwrite its own factor.
    """

    def __init__(self, spec: NodeSpec, size: int) -> None:
        n, p, m = spec.n, spec.p, spec.m
        self.data = np.zeros(size)
        self.xi, self.y, self.u, apart = np.split(self.data, [n, n + p, n + p + m])
        self.xi_y = self.data[: n + p]
        self.apart = tuple(zip(spec.hears, apart.reshape(-1, n), strict=True))
