"""Reduced-order distributed observer that also reconstructs the unknown input and its own noise (seed 004), online.

The node's state s = [z2-hat; eta+] is what its measurements do not give at once: the part of the state that the unknown
input does not reach, and the upper end of an interval around the noise-free output w1. Per tick (seed 004, numbers in
``docs/observers/reduced_order.md``):

    s(k) = Phi s(k-1) + Gamma [y(k); u(k); y(k-1); ...] + K d(k-1) + bias     (8), (15), propagated exactly
    [x-hat; alpha; v-hat](k) = Os s(k) + Oy y(k)                              (8), (19), (26)
    f-hat(k) = f0 - f_alpha alpha(k) - f_rate d(alpha)/dt                     (24), (25)
    d(k) = sum over neighbours a_ij (x-hat_j(k) - x-hat_i(k))                 one exchange, same tick at both ends
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers.base import Estimate
from duio_mesh.observers.differentiator import Differentiator
from duio_mesh.observers.hold import History
from duio_mesh.spec import NodeSpec


class Observer:
    """One node's step machine."""

    rounds = 1

    def __init__(self, spec: NodeSpec) -> None:
        M, size = spec.matrices, spec.p + spec.m
        self._M, self._options, self._hears = M, spec.options, spec.hears
        self._n, self._q = spec.n, spec.options["q"]
        self._history = History(size, M["Gamma"].shape[1] // size)
        self._s = np.zeros(M["Phi"].shape[0])
        self._d = np.zeros(spec.n)
        self._out = np.zeros(M["Os"].shape[0])
        self._f = np.zeros(self._q)
        self._slope: Differentiator | None = None

    def sample(self, y: Array, u: Array) -> None:
        """Propagate to this tick with the coupling frozen at the last one, then read off the estimates."""
        M, n, q = self._M, self._n, self._q
        if self._history.push(y, u):
            self._s = M["Phi"] @ self._s + M["Gamma"] @ self._history.samples + M["K"] @ self._d + M["bias"]
        else:
            self._s[n - q :] = M["W1"] @ y + M["middle"]  # w1 in the middle of its interval: alpha = 1/2
        self._out = M["Os"] @ self._s + M["Oy"] @ y
        alpha = self._out[n : n + q]
        if self._slope is None:
            self._slope = Differentiator(alpha, self._options["h"], self._options["l0"], self._options["l1"])
        self._f = M["f0"] - M["f_alpha"] @ alpha - M["f_rate"] @ self._slope.push(alpha)

    def message(self, r: int) -> Array:
        """x-hat_i(k) (n,)."""
        return self._out[: self._n]

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """d_i(k); an edge whose message is missing is left out of this tick."""
        self._d[:] = 0.0
        own = self._out[: self._n]
        for j, other in received.items():
            self._d += self._hears[j] * (other - own)

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """The z2-hat whose estimate comes nearest to x at this tick; eta+ and the slope start as at the first tick."""
        M, n, z2 = self._M, self._n, self._n - self._q
        self._s[:z2] = np.linalg.lstsq(M["Os"][:n, :z2], x - M["Oy"][:n] @ y, rcond=None)[0]
        self.sample(y, u)

    def estimate(self) -> Estimate:
        """x-hat(k), f-hat(k) and v-hat(k)."""
        n, q = self._n, self._q
        return Estimate(self._out[:n], self._f, self._out[n + q :])
