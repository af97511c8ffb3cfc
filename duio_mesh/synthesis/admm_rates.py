"""What the fusion of one island promises, from its matrices alone: error after k rounds, spectral radius, (17)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg

from duio_mesh.arrays import Array
from duio_mesh.geometry import complement
from duio_mesh.observers.fusion import fusion_rounds, step_size
from duio_mesh.synthesis.admm_options import Options
from duio_mesh.synthesis.stacked import Say, largest_modulus


class Island(NamedTuple):
    """The nodes of one connected component, in the order of their ids."""

    ids: tuple[int, ...]
    T: tuple[Array, ...]  # (r_i, n) each
    L: Array  # (N, N) Laplacian
    H: Array  # (n, n) = sum T_i'T_i
    inverse: Array  # H^-1

    @property
    def degrees(self) -> Array:
        """(N,) weighted degrees d_i."""
        return np.diag(self.L)

    def curvatures(self, normalised: bool) -> Array:
        """(N, n, n): the matrices of the gradients, H^-1 T_i'T_i or T_i'T_i."""
        return np.array([(self.inverse if normalised else np.eye(len(self.H))) @ T.T @ T for T in self.T])

    def step_sizes(self, options: Options) -> Array:
        """(N,) alpha_i of (16), times alpha_factor."""
        inverse = self.inverse if options.normalised else None
        plain = [step_size(T, inverse, options.gamma, d) for T, d in zip(self.T, self.degrees, strict=True)]
        return options.alpha_factor * np.array(plain)


def spectrum(L: Array) -> tuple[float, ...]:
    """The distinct nonzero eigenvalues of a Laplacian in Leja order: each next one far from all before it.

    In that order the intermediate values of the finite-time average stay small.
    """
    values = np.linalg.eigvalsh(L)
    limit = 1e-9 * max(float(values[-1]), 1e-300)
    groups = np.split(values, np.flatnonzero(np.diff(values) > limit) + 1)
    left = [float(g.mean()) for g in groups if g.mean() > limit]
    ordered: list[float] = []
    while left:
        best = max(left, key=lambda v: (sum(np.log(abs(v - o)) for o in ordered), v))
        ordered.append(best)
        left.remove(best)
    return tuple(ordered)


def iterates(island: Island, options: Options) -> Iterator[Array]:
    """(N, n, n) after 0, 1, 2, ... exchanges: column j of block i is x_i if the truth is e_j and xi_i = T_i e_j."""
    run = {"admm": _admm, "finite_time": _finite_time, "relaxed": _relaxed}[options.fusion]
    return run(island, options)


def _spread(L: Array, X: Array) -> Array:
    """(L kron I) X."""
    return np.asarray(L @ X.reshape(len(X), -1)).reshape(len(L), *X.shape[1:])


def _admm(island: Island, options: Options) -> Iterator[Array]:
    M, alpha = island.curvatures(options.normalised), island.step_sizes(options)[:, None, None]
    X = alpha * M
    psi = np.zeros_like(X)
    while True:
        yield X
        phi = options.gamma / 2 * _spread(island.L, X)
        psi = psi + phi
        X = X - alpha * (M @ X - M + phi + psi)


def _finite_time(island: Island, options: Options) -> Iterator[Array]:
    X = len(island.T) * island.curvatures(normalised=True)
    yield X
    for value in spectrum(island.L):
        X = X - _spread(island.L, X) / value
        yield X


def _relaxed(island: Island, options: Options) -> Iterator[Array]:
    M, c = island.curvatures(normalised=True), options.c
    adjacency, solve = np.diag(island.degrees) - island.L, _relaxed_solve(island, c)
    X = solve @ M
    while True:
        yield X
        X = solve @ (M + c * _spread(adjacency, X))


def _relaxed_solve(island: Island, c: float) -> Array:
    """(N, n, n): the inverses of H^-1 T_i'T_i + c d_i I."""
    own = island.curvatures(normalised=True) + c * island.degrees[:, None, None] * np.eye(len(island.H))
    return np.asarray(np.linalg.inv(own), dtype=np.float64)


def worst_error(X: Array) -> float:
    """The largest error of any node for any true state of norm 1."""
    return float(np.linalg.norm(X - np.eye(X.shape[1]), 2, axis=(1, 2)).max())


def predicted_errors(island: Island, options: Options, rounds: int, say: Say = lambda _: None) -> dict[int, float]:
    """``worst_error`` after some numbers of exchanges, among them ``rounds``."""
    wanted = sorted({0, 1, 2, 5, 10, 20, 30, 40, 50, 60, 80, 100, 200, 500, 1000, 3000, 10000, rounds})
    found = {}
    for k, X in enumerate(islice(iterates(island, options), rounds + 1)):
        if k % 50 == 0:
            say(f"predicted error, round {k} of {rounds}")
        if k in wanted:
            found[k] = worst_error(X)
    return found


def fused_maps(island: Island, options: Options) -> Array:
    """(k, n, sum of r_i): what the fusion ends in, as a map from all stacked xi_i; k = 1 where all nodes agree.

    H^-1 [T_1' T_2' ...], the least-squares solution (12), for admm and finite_time; relaxed nodes agree only on
    consistent xi.
    """
    pull = [island.inverse @ T.T for T in island.T]
    if options.fusion != "relaxed":
        return np.hstack(pull)[None]
    n, N = len(island.H), len(island.T)
    own = linalg.block_diag(*(G @ T for G, T in zip(pull, island.T, strict=True)))
    end = np.linalg.solve(own + options.c * np.kron(island.L, np.eye(n)), linalg.block_diag(*pull))
    return np.asarray(end).reshape(N, n, -1)


def fusion_radius(island: Island, options: Options, say: Say = lambda _: None) -> float:
    """Spectral radius of the fusion's error from round to round; 0 for finite_time, which is exact after its rounds.

    Up to stacked.DENSE rows from all eigenvalues, beyond that by Arnoldi's method from products with blocks.
    """
    if options.fusion == "finite_time":
        return 0.0
    N, n = len(island.T), len(island.H)
    if options.fusion == "relaxed":
        solve, adjacency = _relaxed_solve(island, options.c), np.diag(island.degrees) - island.L

        def relaxed(X: Array) -> Array:
            return (options.c * solve @ _spread(adjacency, X.reshape(N, n, -1))).reshape(X.shape)

        return largest_modulus(N * n, relaxed, lambda: relaxed_matrix(island, options.c, island.degrees), say)
    steps = island.step_sizes(options)
    times = admm_product(island, options, steps)
    return largest_modulus((2 * N - 1) * n, times, lambda: admm_matrix(island, options, steps), say)


def admm_product(island: Island, options: Options, steps: Array) -> Callable[[Array], Array]:
    """Products with ``admm_matrix``, block by block: ((2N - 1) n, k) -> the same."""
    N, n = len(island.T), len(island.H)
    Q = complement(np.ones((N, 1)) / np.sqrt(N))
    M, alpha, half = island.curvatures(options.normalised), steps[:, None, None], options.gamma / 2

    def times(Z: Array) -> Array:
        X, q = Z[: N * n].reshape(N, n, -1), Z[N * n :].reshape(N - 1, n, -1)
        X = X - alpha * (M @ X + half * _spread(island.L, X) + _spread(Q, q))
        q = q + _spread(Q.T, half * _spread(island.L, X))
        return np.vstack([X.reshape(N * n, -1), q.reshape((N - 1) * n, -1)])

    return times


def relaxed_matrix(island: Island, c: float, degrees: Array) -> Array:
    """(N n, N n): the relaxed fusion's error recursion when the nodes take their degrees for ``degrees`` (N,).

    What a node misses of its degree it takes to agree with itself.
    """
    n, N = len(island.H), len(island.T)
    own = island.curvatures(normalised=True) + c * degrees[:, None, None] * np.eye(n)
    weights = np.diag(degrees) - island.L
    return np.asarray(c * np.einsum("iab,ij->iajb", np.linalg.inv(own), weights)).reshape(N * n, N * n)


def admm_matrix(island: Island, options: Options, steps: Array) -> Array:
    """The error recursion of (15) with step sizes (N,) in (x, q), psi = (Q kron I) q, Q the complement of (1, ..., 1).

    The sum of all psi_i is zero for ever; leaving it out removes n eigenvalues 1 that mean nothing.
    """
    N, n = len(island.T), len(island.H)
    Q, unit = complement(np.ones((N, 1)) / np.sqrt(N)), np.eye(n)
    alpha = np.repeat(steps, n)[:, None]
    M = np.zeros((N * n, N * n))
    for i, block in enumerate(island.curvatures(options.normalised)):
        M[i * n : (i + 1) * n, i * n : (i + 1) * n] = block
    half = options.gamma / 2
    F11 = np.eye(N * n) - alpha * (M + half * np.kron(island.L, unit))
    F12 = -alpha * np.kron(Q, unit)
    pull = half * np.kron(Q.T @ island.L, unit)
    return np.block([[F11, F12], [pull @ F11, np.eye((N - 1) * n) + pull @ F12]])


def rounds_to(error: float, island: Island, options: Options, radius: float, say: Say = lambda _: None) -> int | None:
    """Exchanges until the worst error is below ``error``; None when the fusion does not get there.

    Followed exactly for 500 exchanges, then extrapolated with the spectral radius.
    """
    last, reached, enough = 0, np.inf, np.sqrt(len(island.H)) * error
    for last, X in enumerate(islice(iterates(island, options), 501)):
        if last % 50 == 0:
            say(f"error after {last} rounds")
        if (
            last == 500 or np.linalg.norm(X - np.eye(X.shape[1]), axis=(1, 2)).max() <= enough
        ):  # not above sqrt(n) |.|_2
            reached = worst_error(X)
            if reached <= error:
                return last
    if options.fusion == "finite_time" or radius >= 1:
        return None
    return last + int(np.ceil(np.log(reached / error) / -np.log(radius)))


def theorem_bound(island: Island, options: Options, nu: int, size: float) -> float:
    """The right-hand side of (17) for |x| = size: bounds |mean of x_i[1..nu] - x|, not the last iterate.

    In the coordinates of the problem that is solved (z = S x, |z| = size, when normalised). The second term is
    1 / (nu sqrt(lambda_2)) times the bracket, as it follows from (19); the paper prints 1 / sqrt(nu lambda_2).
    """
    steps = float(np.sum(1 / island.step_sizes(options)))
    mu = 1.0 if options.normalised else float(np.linalg.eigvalsh(island.H)[0])
    first = np.sqrt(steps / (nu * mu)) * size
    if len(island.T) == 1:
        return float(first)
    connectivity = float(np.linalg.eigvalsh(island.L)[1])
    return float(first + (2 / options.gamma + steps * size**2 / 2) / (nu * np.sqrt(connectivity)))


def island_facts(
    island: Island, options: Options, eigenvalues: Array, radius: float, gains: Array, say: Say
) -> dict[str, Any]:
    """What the certificate says about one island."""
    rounds = fusion_rounds({**options.model_dump(), "eigenvalues": spectrum(island.L)})
    return {
        "nodes": list(island.ids),
        "H_eigenvalues": eigenvalues.tolist(),
        "H_condition": float(eigenvalues[-1] / eigenvalues[0]),
        "fusion_radius": radius,
        "rounds": rounds,
        "rounds_to_1e-6": rounds_to(1e-6, island, options, radius, say),
        "predicted_fusion_error": {str(k): e for k, e in predicted_errors(island, options, rounds, say).items()},
        "noise_gain": gains.tolist(),
    }
