"""Solving min over x of sum_i |T_i x - xi_i|^2 / 2 by exchanging x alone (seed 002, (7)-(16) and (PS)): three ways.

With H = sum_i T_i'T_i = S'S the normalised problem of (25)-(27) in z = S x has the gradient S^-T T_i'(T_i x - xi_i).
Multiplied by S^-1 the whole iteration is in x again, with H^-1 in front of the gradient: nodes exchange estimates of x,
and S never appears.

Every class solves W problems at once (a block, see ``blocks``): ``begin`` takes xi (r W,), ``message`` gives (n W,),
``state`` is the result (n W,). Column w has the same bits for every W.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers.blocks import ColumnProduct, Neighbourhood


class Fusion(Protocol):
    """One node's part of the fusion of one block."""

    state: Array  # (n W,) what this node holds; after the last round its estimates

    def begin(self, xi: Array) -> None:
        """Start a block from xi (r W,), forgetting the last one."""
        ...

    def message(self, r: int) -> Array:
        """(n W,) for the neighbours in round r."""
        ...

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """Use what the neighbours sent in round r."""
        ...


class LinearisedAdmm:
    """(15) with x[0] = phi[0] = psi[0] = 0; nu - 1 exchanges lead to x[nu].

        x[k+1] = x[k] - alpha (M x[k] - b + phi[k] + psi[k])
        phi[k] = gamma/2 sum_j a_ij (x_i[k] - x_j[k]),   psi[k] = psi[k-1] + phi[k]

    M = H^-1 T'T and b = H^-1 T'xi when normalised, T'T and T'xi otherwise. Needs every message of every round: a lost
    one biases the sum of all psi_i, which should be zero, and with it the result of this block.
    """

    def __init__(
        self, T: Array, inverse: Array | None, hears: Mapping[int, float], options: Mapping[str, Any], width: int = 1
    ) -> None:
        """``inverse`` is H^-1 (n, n), None without normalisation; options: gamma, nu, alpha_factor."""
        n, gamma, degree = T.shape[1], options["gamma"], sum(hears.values())
        alpha = options["alpha_factor"] * step_size(T, inverse, gamma, degree)
        weighted = T.T if inverse is None else inverse @ T.T  # H^-1 T' or T'
        self._near = Neighbourhood(hears, n * width)
        self.state = self._near.own
        self._xi = np.zeros(len(T) * width)
        self._pull = self._near.weights(
            -alpha * gamma / 2 * degree, {j: alpha * gamma / 2 * a for j, a in hears.items()}
        )
        self._load = ColumnProduct(alpha * weighted, self._xi, self.state)
        self._advance = ColumnProduct(np.eye(n) - alpha * weighted @ T, self.state, self.state, more=2)
        self._s, self._p = self._advance.added

    def begin(self, xi: Array) -> None:
        """x[1] = alpha b. Inside, s = -alpha phi and p = -alpha (psi - b)."""
        self._near.forget()
        self._xi[:] = xi
        self._load()
        self._p[:] = self.state

    def message(self, r: int) -> Array:
        """x[r+1]."""
        return self.state

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """x[r+2] = (I - alpha M) x[r+1] + s + p."""
        self._near.receive(received)
        self._near.combine(self._pull, self._s)
        np.add(self._p, self._s, self._p)
        self._advance()


def step_size(T: Array, inverse: Array | None, gamma: float, degree: float) -> float:
    """alpha_i of (16): 1 / (K_i + gamma d_i) with K_i = |S^-T T_i'T_i S^-1| when normalised, |T_i'T_i| otherwise."""
    if not T.size:
        K = 0.0
    elif inverse is None:
        K = float(np.linalg.norm(T, 2)) ** 2
    else:
        K = float(np.linalg.eigvalsh(T @ inverse @ T.T)[-1])
    return 1.0 / (K + gamma * degree) if K + gamma * degree > 0 else 0.0


class FiniteTimeAverage:
    """The mean over an island in as many rounds as its Laplacian has distinct nonzero eigenvalues lambda_k:

        x_i <- x_i - (1 / lambda_k) sum_j a_ij (x_i - x_j),   k = 1 .. D.

    Exact up to rounding, for any values, on any connected undirected graph. D is the diameter on rings, paths, stars
    and complete graphs, and at most N - 1. A missing neighbour is left out of its round; the result is then wrong.
    """

    def __init__(self, hears: Mapping[int, float], eigenvalues: Sequence[float], size: int) -> None:
        """``eigenvalues`` in the order of use (Leja order keeps the intermediate values small)."""
        degree = sum(hears.values())
        self.rounds = len(eigenvalues)
        self._near = Neighbourhood(hears, size)
        self.state = self._near.own
        self._weights = [self._near.weights(1 - degree / v, {j: a / v for j, a in hears.items()}) for v in eigenvalues]
        self._next = np.zeros(size)

    def message(self, r: int) -> Array:
        """This node's value before round r."""
        return self.state

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """Its value after round r."""
        self._near.assume_own(received)
        self._near.combine(self._weights[r], self._next)
        self.state[:] = self._next


class FiniteTime(FiniteTimeAverage):
    """The exact least-squares solution (12), also for inconsistent xi: the island's mean of N H^-1 T_j'xi_j."""

    def __init__(
        self, T: Array, inverse: Array, hears: Mapping[int, float], options: Mapping[str, Any], width: int = 1
    ) -> None:
        """Options: island_size N and the island's ``eigenvalues``."""
        super().__init__(hears, options["eigenvalues"], T.shape[1] * width)
        self._xi = np.zeros(len(T) * width)
        self._load = ColumnProduct(options["island_size"] * inverse @ T.T, self._xi, self.state)

    def begin(self, xi: Array) -> None:
        """x_i[0] = N H^-1 T_i'xi_i."""
        self._xi[:] = xi
        self._load()


class Relaxed:
    """Block relaxation without dual variables, always with the latest value of every neighbour:

        (H^-1 T_i'T_i + c d_i I) x_i = H^-1 T_i'xi_i + c sum_j a_ij x_j.

    Its fixed point is x when every xi_i = T_i x, whatever was lost, late or repeated on the way. With noise the nodes
    end apart and noisier than least squares, the more so the smaller c is. A value that never came counts as zero.
    """

    def __init__(
        self, T: Array, inverse: Array, hears: Mapping[int, float], options: Mapping[str, Any], width: int = 1
    ) -> None:
        """Options: c and the number of rounds."""
        n, c, degree = T.shape[1], options["c"], sum(hears.values())
        solve = np.linalg.inv(inverse @ T.T @ T + c * degree * np.eye(n))
        self._near = Neighbourhood(hears, n * width)
        self.state = self._near.own
        self._xi, self._pull = np.zeros(len(T) * width), np.zeros(n * width)
        self._weights = self._near.weights(0.0, hears)
        self._follow = ColumnProduct(c * solve, self._pull, self.state, more=1)
        self._b = self._follow.added[0]
        self._load = ColumnProduct(solve @ inverse @ T.T, self._xi, self._b)

    def begin(self, xi: Array) -> None:
        """x_i as if every neighbour said zero."""
        self._near.forget()
        self._xi[:] = xi
        self._load()
        self.state[:] = self._b

    def message(self, r: int) -> Array:
        """The latest x_i."""
        return self.state

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        """The next x_i."""
        self._near.receive(received)
        self._near.combine(self._weights, self._pull)
        self._follow()


def fusion_rounds(options: Mapping[str, Any]) -> int:
    """Exchanges per block."""
    if options["fusion"] == "admm":
        return int(options["nu"]) - 1
    return len(options["eigenvalues"]) if options["fusion"] == "finite_time" else int(options["rounds"])


FUSIONS: Mapping[str, Any] = {"admm": LinearisedAdmm, "finite_time": FiniteTime, "relaxed": Relaxed}


def make_fusion(
    T: Array, inverse: Array | None, hears: Mapping[int, float], options: Mapping[str, Any], width: int = 1
) -> Fusion:
    """The fusion that ``options["fusion"]`` names, for blocks of ``width`` steps. T is (r, n), H^-1 is (n, n)."""
    fusion: Fusion = FUSIONS[options["fusion"]](T, inverse, hears, options, width)
    return fusion
