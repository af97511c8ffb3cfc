"""What seed 001 prints in Example 9."""

from __future__ import annotations

import numpy as np

H = {1: [[1, -1], [0, 1], [1, -1]], 2: [[0, 1], [0, 0], [1, 0]], 3: [[0, 1], [0, 0], [1, 0]]}
D = {1: [[0, 1], [1, 0], [0, 1]], 2: [[1, 1], [0, 0], [0, 1]], 3: [[1, 1], [0, 0], [0, 1]]}
M = {1: [[0], [0], [-1]], 2: [[0], [1], [0]], 3: [[0], [1], [-1]]}
N = {
    1: [[0, 0, 0], [0, 0, 0], [-0.6, -0.6, 0]],
    2: [[0, 0, 0], [0, 1.2, 1.4], [0, 0, 0]],
    3: [[0, 0, 0], [0, -0.8, -2.6], [0, 0.8, 2.6]],
}
L = {1: [[0, 0], [0, 0], [-0.6, 0]], 2: [[0, 0], [-0.6, 0], [0, 0]], 3: [[0, 0], [-0.6, 0], [0.6, 0]]}
K = {
    1: [[-1.96, -2.96, -2.96], [-8.93, -7.93, -8.93], [1.98, 1.98, 2.98]],
    2: [[0.16, -2.21, -0.61], [2.10, 1.56, 2.05], [1.90, 0.70, -2.77]],
    3: [[-1.62, 0.13, 0.66], [1.79, 1.61, 0.91], [-0.42, -0.64, -1.11]],
}
Q1 = [[-20.33, 0.30], [-51.17, 3.52], [2.59, 3.83]]
R1 = [[1, 1, 1], [0, 0, 0]]
S1 = [[7.11, -0.47], [1, 0]]
LAPLACIAN = [[1, -1, 0], [-1, 2, -1], [0, -1, 1]]


def F(repaired: bool = False) -> dict[int, list[list[float]]]:
    """L - N H of the printed matrices; ``repaired``: with N_2(2,3) = 0.4 instead of 1.4."""
    found = {i: (np.array(L[i]) - np.array(N[i]) @ np.array(H[i])) for i in N}
    if repaired:
        found[2] = found[2] + np.array([[0, 0], [1, 0], [0, 0]])
    return {i: np.round(f, 12).tolist() for i, f in found.items()}


def phi(gains: dict[int, dict[str, object]], laplacian: object = LAPLACIAN) -> np.ndarray:
    """(12) from N, K, Q, R, S of nodes 1, 2, 3, put together by hand."""
    n, N_ = 3, len(gains)
    beta = [len(np.atleast_2d(g["S"])) if np.size(g["S"]) else 0 for g in gains.values()]
    size = n * N_ + sum(beta)
    lap = np.array(laplacian, dtype=float)
    out = np.zeros((size, size))
    at = n * N_
    for k, (g, b) in enumerate(zip(gains.values(), beta, strict=True)):
        own = slice(k * n, (k + 1) * n)
        xi = slice(at, at + b)
        out[own, own] += np.array(g["N"])
        for j in range(N_):
            other = slice(j * n, (j + 1) * n)
            out[own, other] += lap[k, j] * np.array(g["K"])
            if b:
                out[xi, other] += lap[k, j] * np.array(g["R"])
        if b:
            out[own, xi] = g["Q"]
            out[xi, xi] = g["S"]
        at += b
    return out
