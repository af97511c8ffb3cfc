"""One node of the augmented-state observer (seed 001, (6)), for any augmented order beta >= 0.

    z+  = N z + M u + L y - K s - Q xi        s = sum over the neighbours heard of a_ij (x-hat_j - x-hat_i)
    xi+ = S xi + R s
    x-hat = z + H y

A neighbour that is not heard in a step is left out of s. With delay 1 the message of step k is x-hat(k-1), on both
sides of the difference, so the network has a whole step to deliver it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duio_mesh.arrays import Array, contiguous
from duio_mesh.observers.base import Estimate
from duio_mesh.spec import NodeSpec


class Observer:
    """The step machine; ``spec.matrices`` holds N, M, L, H, K, Q, R, S and ``spec.options`` the delay."""

    rounds = 1

    def __init__(self, spec: NodeSpec) -> None:
        m = spec.matrices
        n, beta = spec.n, m["S"].shape[0]
        zeros = np.zeros((beta, spec.p + spec.m))
        self._local = contiguous(np.block([[m["N"], -m["Q"], m["L"], m["M"]], [np.zeros((beta, n)), m["S"], zeros]]))
        self._coupling = contiguous(np.vstack([-m["K"], m["R"]]))
        self._H = m["H"]
        self._hears = tuple(spec.hears.items())
        own = np.zeros(n + beta + spec.p + spec.m)  # [z; xi; y; u], written in place
        self._own, self._z, self._state = own, own[:n], own[: n + beta]
        self._y, self._u = own[n + beta : n + beta + spec.p], own[n + beta + spec.p :]
        self._xhat, self._s, self._difference = np.zeros(n), np.zeros(n), np.zeros(n)
        self._next, self._pull = np.zeros(n + beta), np.zeros(n + beta)
        self._delayed = bool(spec.options["delay"])
        self._previous = np.zeros(n)  # x-hat(k-1); before step 0 every node says zero, so s = 0
        self._said = self._previous if self._delayed else self._xhat

    def sample(self, y: Array, u: Array) -> None:
        """x-hat(k) from y(k), and the part of the next state that needs no neighbour."""
        self._previous[:] = self._xhat
        self._y[:], self._u[:] = y, u
        np.dot(self._H, y, out=self._xhat)
        self._xhat += self._z
        np.dot(self._local, self._own, out=self._next)

    def message(self, r: int) -> Array:
        """x-hat(k), or x-hat(k-1) with delay 1."""
        return self._said

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """Add the neighbours' pull and step z and xi."""
        self._s.fill(0.0)
        for j, weight in self._hears:
            if j in received:
                np.subtract(received[j], self._said, out=self._difference)
                self._difference *= weight
                self._s += self._difference
        np.dot(self._coupling, self._s, out=self._pull)
        np.add(self._next, self._pull, out=self._state)

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """z from x-hat, then a step without neighbours; xi starts at zero."""
        self._z[:] = x - self._H @ y
        self.sample(y, u)
        self.exchange(0, {})

    def estimate(self) -> Estimate:
        """x-hat(k)."""
        return Estimate(self._xhat)
