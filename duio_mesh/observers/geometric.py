"""Geometric unknown-input observer, centralised and distributed (seed 003), online.

Per tick, with everything between ticks integrated exactly and the coupling frozen at one common tick:

    z(k) = Phi z(k-1) + Gamma [y(k); u(k); y(k-1); ...] + K push(k-1)         (9), (19) or (20)
    x-hat(k) = X z(k) + F y(k)
    d(k) = sum over neighbours a_ij (x-hat_j(k) - x-hat_i(k))                 one exchange, same tick at both ends
    push(k) = chi R d + gamma sat(R d / width)                                R = V_i' in N1, W_g,i' in N2

A neighbour's estimate of an older tick would bias the difference by step x |dx/dt|, 100 times the error reached here.
``width`` 0 stands for the sign itself; in N1 gamma is 0.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers.base import Estimate
from duio_mesh.observers.hold import History
from duio_mesh.spec import NodeSpec


class Observer:
    """One node's step machine."""

    rounds = 1

    def __init__(self, spec: NodeSpec) -> None:
        M, size = spec.matrices, spec.p + spec.m
        self._M, self._hears = M, spec.hears
        self._chi, self._gamma, self._width = (spec.options[name] for name in ("chi", "gamma", "width"))
        self._history = History(size, M["Gamma"].shape[1] // size)
        self._z: Array = np.zeros(M["Phi"].shape[0])
        self._push = np.zeros(M["R"].shape[0])
        self._x = np.zeros(spec.n)

    def sample(self, y: Array, u: Array) -> None:
        """Propagate to this tick with the coupling frozen at the last one, then read off the estimate."""
        M = self._M
        if self._history.push(y, u):
            self._z = M["Phi"] @ self._z + M["Gamma"] @ self._history.samples + M["K"] @ self._push
        self._x = M["X"] @ self._z + M["F"] @ y

    def message(self, r: int) -> Array:
        """x-hat_i(k) (n,)."""
        return self._x

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """The coupling for the next interval; an edge whose message is missing is left out of it."""
        d = np.zeros_like(self._x)
        for j, other in received.items():
            d += self._hears[j] * (other - self._x)
        a = self._M["R"] @ d
        self._push = self._chi * a
        if self._gamma:
            self._push += self._gamma * (np.clip(a / self._width, -1.0, 1.0) if self._width else np.sign(a))

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """The z whose estimate comes nearest to x at this tick; no coupling until the next."""
        z = np.linalg.lstsq(self._M["X"], x - self._M["F"] @ y, rcond=None)[0]
        self._z = z.astype(np.float64, copy=False)
        self.sample(y, u)

    def estimate(self) -> Estimate:
        """x-hat(k)."""
        return Estimate(self._x)
