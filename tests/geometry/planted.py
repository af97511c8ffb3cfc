"""Systems with a known structure: built in coordinates where the answer can be read off, then hidden."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg


def basis_change(rng: np.random.Generator, n: int) -> np.ndarray:
    """A random well-conditioned transformation (singular values between 1/2 and 2)."""
    if not n:
        return np.zeros((0, 0))
    U, V = (linalg.qr(rng.standard_normal((n, n)))[0] for _ in range(2))
    return U @ np.diag(rng.uniform(0.5, 2.0, n)) @ V


def spectrum_block(rng: np.random.Generator, values: list[complex]) -> np.ndarray:
    """A real matrix with these eigenvalues; one with imag > 0 stands for its pair."""
    blocks = [
        np.array([[v.real, v.imag], [-v.imag, v.real]]) if v.imag else np.array([[v.real]])
        for v in map(complex, values)
    ]
    D = linalg.block_diag(*blocks) if blocks else np.zeros((0, 0))
    T = basis_change(rng, len(D))
    return T @ D @ np.linalg.inv(T) if len(D) else D


@dataclass
class Planted:
    """y = C x, x+ = A x + B u with known W*, S*, zeros."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    W: np.ndarray  # orthonormal bases
    S: np.ndarray
    Wg: np.ndarray
    zeros: np.ndarray
    bad: int


def morse(
    rng: np.random.Generator, good: list[complex], bad: list[complex], chains: list[int], free: int, seen: int
) -> Planted:
    """A system in Morse's canonical form, hidden by output injection, feedback and changes of all three bases.

    ``good`` and ``bad``: zeros. ``chains``: lengths of integrator chains from an input to an output (zeros at
    infinity). ``free``: states driven by an input of their own that reach no output. ``seen``: states that no input
    reaches, with an output of their own. W* = chains + free, S* = W* + zeros.
    """
    Zg, Zb = spectrum_block(rng, good), spectrum_block(rng, bad)
    shifts = [np.eye(q, k=1) for q in chains]
    n_in, n_out = len(chains) + (free > 0), len(chains) + (seen > 0)
    A = linalg.block_diag(Zg, Zb, *shifts, np.eye(free, k=1), np.eye(seen, k=1))
    n = len(A)
    z, b = len(Zg), len(Zb)
    B, C = np.zeros((n, n_in)), np.zeros((n_out, n))
    at = z + b
    for k, q in enumerate(chains):
        B[at + q - 1, k] = C[k, at] = 1.0
        at += q
    if free:
        B[at + free - 1, -1] = 1.0
    if seen:
        C[-1, at + free] = 1.0
    A = A + rng.standard_normal((n, n_out)) @ C + B @ rng.standard_normal((n_in, n))
    T = basis_change(rng, n)
    Ti = np.linalg.inv(T)
    drawn = slice(z + b, at + free)
    W = T[:, drawn]
    return Planted(
        A=T @ A @ Ti,
        B=T @ B @ basis_change(rng, n_in),
        C=basis_change(rng, n_out) @ C @ Ti,
        W=_orthonormal(W),
        S=_orthonormal(np.hstack([W, T[:, : z + b]])),
        Wg=_orthonormal(np.hstack([W, T[:, z : z + b]])),
        zeros=np.concatenate([np.linalg.eigvals(Zg), np.linalg.eigvals(Zb)]),
        bad=b,
    )


def _orthonormal(M: np.ndarray) -> np.ndarray:
    return linalg.qr(M, mode="economic")[0] if M.shape[1] else M


def unobservable(
    rng: np.random.Generator, seen: list[complex], good: list[complex], bad: list[complex], p: int
) -> tuple:
    """(C, A, U, Ub): U the unobservable subspace, Ub its part with the eigenvalues ``bad``; eigenvalues as given."""
    Ad, Ag, Ab = (spectrum_block(rng, v) for v in (seen, good, bad))
    d, u, b = len(Ad), len(Ag) + len(Ab), len(Ab)
    A = linalg.block_diag(Ad, Ag, Ab)
    A[d:, :d] = rng.standard_normal((u, d))
    C = np.hstack([rng.standard_normal((p, d)), np.zeros((p, u))])
    T = basis_change(rng, d + u)
    Ti = np.linalg.inv(T)
    return C @ Ti, T @ A @ Ti, _orthonormal(T[:, d:]), _orthonormal(T[:, d + u - b :])
