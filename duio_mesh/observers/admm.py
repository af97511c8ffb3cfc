"""One node of the observer by distributed optimisation (seed 002): local estimate, then fusion with the neighbours.

Per step k, with T_i = [P_i; C_i] (the part of the state that this node can follow alone, and what it measures):

    xi_i(k) = [s_i(k); y_i(k)]                                   local, no message
    x_i(k)  = fusion of all xi_j(k)                              ``fusion``: nu - 1 exchanges, or D, or ``rounds``
    s_i(k+1) = Abar_i s_i(k) - P_i L_i y_i(k) + P_i B_i u_i(k)   (5)

With a distributed set-up, step 0 begins with D more rounds in which the nodes find H = sum_j T_j'T_j themselves: the
exact mean of the n (n+1)/2 numbers of T_j'T_j over the island, times the island's size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from duio_mesh.arrays import Array, contiguous
from duio_mesh.errors import RunError
from duio_mesh.observers.base import Estimate
from duio_mesh.observers.fusion import FiniteTimeAverage, Fusion, fusion_rounds, make_fusion
from duio_mesh.observers.watch import RoundWatch
from duio_mesh.spec import NodeSpec

OnRound = Callable[[int, float, float], None]
"""Called as on_round(r, residual, disagreement) for the iterate that round r exchanges."""


class Observer:
    """The step machine; ``spec.matrices`` holds Abar, PL, PB, T, s0 and, where the launcher found H, Hinv.

    Where the nodes find H themselves, they do so for states in ``units``, in which its inverse has its digits.
    """

    def __init__(self, spec: NodeSpec) -> None:
        m, n = spec.matrices, spec.n
        self._id, self._hears, self._options, self._T = spec.id, spec.hears, spec.options, m["T"]
        self._local = contiguous(np.hstack([m["Abar"], -m["PL"], m["PB"]]))
        states = m["Abar"].shape[0]
        self._own = np.zeros(states + spec.p + spec.m)  # [s; y; u], written in place
        self._s, self._xi = self._own[:states], self._own[: states + spec.p]
        self._y, self._u = self._own[states : states + spec.p], self._own[states + spec.p :]
        self._next = m["s0"].copy()
        self._xhat = np.zeros(n)
        self.on_round: OnRound | None = None
        """Set it before a step to watch that step's rounds: |T_i x_i - xi_i| and the largest |x_i - x_j| heard."""
        self._watch, self._watched = RoundWatch(fusion_rounds(self._options)), spec.options.get("watch_step")
        self._steps = self._left = spec.steps
        self._full = spec.batch
        self._block: list[Array] = []  # xi of the samples that the next rounds fuse
        self._fusions: dict[int, Fusion] = {}  # by width: the last block of a run may be shorter
        self._fusion: Fusion | None = None
        self._Hinv, self._units = m.get("Hinv"), m.get("units", np.ones(n))
        self._setup, self._ready = FiniteTimeAverage({}, (), 0), spec.options["setup"] == "global"
        if not self._ready:
            self._setup = FiniteTimeAverage(spec.hears, spec.options["eigenvalues"], n * (n + 1) // 2)
            T = m["T"] * self._units
            self._setup.state[:] = (T.T @ T)[np.tril_indices(n)]
        self._ahead = self._setup.rounds  # rounds before the fusion's first, in this block

    @property
    def rounds(self) -> int:
        """Exchanges of the current block; the set-up adds some to the first."""
        return self._ahead + fusion_rounds(self._options)

    def sample(self, y: Array, u: Array) -> None:
        """xi_i(k), and s_i(k+1), which needs no neighbour."""
        self._s[:] = self._next
        self._y[:], self._u[:] = y, u
        np.dot(self._local, self._own, out=self._next)
        if len(self._block) == self._full:
            self._block = []
        self._block.append(self._xi.copy())
        self._left -= 1
        if len(self._block) < self._full and self._left:
            return
        if self._ready:
            self._ahead = 0
            self._begin()
        elif not self._ahead:
            self._finish_setup()

    def message(self, r: int) -> Array:
        """The iterate x_i (n,); in a set-up round n (n+1)/2 numbers, the lower triangle of a mean of T_j'T_j."""
        if r < self._ahead or self._fusion is None:
            return self._setup.message(r)
        return self._fusion.message(r - self._ahead)

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """The next iterate from the neighbours' present ones. Raises RunError when one is missing in a set-up round."""
        if self._ready and self._fusion is not None:
            if self.on_round is not None:
                self._tell(self.on_round, r, self._fusion.state, received)
            self._fusion.exchange(r - self._ahead, received)
            return
        silent = sorted(self._hears.keys() - received.keys())
        if silent:
            raise RunError(
                f"node {self._id}: no message from node(s) {silent} in round {r} of the set-up, which needs every one; "
                "where messages get lost, let the launcher find H (observer.setup: global)"
            )
        self._setup.exchange(r, received)
        if r + 1 == self._ahead:
            self._finish_setup()

    def resume(self, x: Array, y: Array, u: Array) -> None:
        """s_i(k+1) by (5) from s_i(k) = P_i x-hat(k)."""
        self._s[:] = self._T[: self._s.size] @ x
        self._y[:], self._u[:] = y, u
        np.dot(self._local, self._own, out=self._next)

    def estimate(self) -> Estimate:
        """x_i of the newest sample, after the last round."""
        return self.batch()[-1] if self._fusion else Estimate(self._xhat)

    def batch(self) -> Sequence[Estimate]:
        """x_i of every sample of the block, after the last round."""
        if self._fusion is None:
            return ()
        columns = self._fusion.state.reshape(self._xhat.size, -1)
        return [Estimate(contiguous(column)) for column in columns.T]

    def watched(self) -> Array:
        """Rows (m, 3) [round, residual, disagreement] of the watched step's block, once; (0, 3) at all other times."""
        return self._watch.take()

    def _begin(self) -> None:
        """Start the fusion of the block's xi, side by side."""
        width = len(self._block)
        if self._watched is not None:
            after = self._steps - self._left
            self.on_round = self._watch if after - width <= self._watched < after else None
        if width not in self._fusions:
            self._fusions[width] = make_fusion(self._T, self._Hinv, self._hears, self._options, width)
        self._fusion = self._fusions[width]
        self._fusion.begin(np.stack(self._block, axis=1).ravel())

    def _finish_setup(self) -> None:
        """H from the mean of all T_j'T_j. Every node's copy differs in the last bits; nothing compares them."""
        n = self._T.shape[1]
        H: Array = np.zeros((n, n))
        H[np.tril_indices(n)] = self._options["island_size"] * self._setup.state
        H += np.tril(H, -1).T
        self._Hinv, self._ready = np.linalg.inv(H).astype(np.float64) * np.outer(self._units, self._units), True
        self._begin()

    def _tell(self, on_round: OnRound, r: int, x: Array, received: Mapping[int, Array]) -> None:
        apart = max((float(np.linalg.norm(x - other)) for other in received.values()), default=0.0)
        residual = self._T @ x.reshape(self._xhat.size, -1) - np.stack(self._block, axis=1)
        on_round(r - self._ahead, float(np.linalg.norm(residual)), apart)
