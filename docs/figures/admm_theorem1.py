"""The figure of docs/observers/admm.md: Theorem 1's bound (17) of seed 002 against what the observers do.

python bench/admm_theorem1.py docs/observers/admm_theorem1.png
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.observers.fusion import make_fusion
from duio_mesh.synthesis.admm import island_of
from duio_mesh.synthesis.admm_local import local_estimates
from duio_mesh.synthesis.admm_rates import Island, theorem_bound

HERE = Path(__file__).parent
RING = HERE.parents[1] / "topologies" / "admm_ring.yaml"


def errors(part: Island, options: dict, hears: dict, x: np.ndarray, normalised: bool) -> tuple[np.ndarray, np.ndarray]:
    """Per nu: the worst node's |mean of z[1..nu] - z| and |z[nu] - z|, from the nodes' own fusions."""
    S = np.linalg.cholesky(part.H).T if normalised else np.eye(len(x))
    inverse = part.inverse if normalised else None
    nodes = {i: make_fusion(T, inverse, hears[i], options) for i, T in zip(part.ids, part.T, strict=True)}
    total, means, last = {i: np.zeros_like(x) for i in nodes}, [], []
    for i, T in zip(part.ids, part.T, strict=True):
        nodes[i].begin(T @ x)
    for nu in range(1, options["nu"] + 1):
        sent = {i: node.message(nu - 1).copy() for i, node in nodes.items()}
        total = {i: total[i] + S @ (sent[i] - x) for i in nodes}
        means.append(max(np.linalg.norm(v) for v in total.values()) / nu)
        last.append(max(np.linalg.norm(S @ (v - x)) for v in sent.values()))
        for i, node in nodes.items():
            node.exchange(nu - 1, {j: sent[j] for j in hears[i]})
    return np.array(means), np.array(last)


def main() -> None:
    """Both forms of the algorithm on the ring, for the state of step 40."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.1), sharey=True, layout="constrained")
    for axis, (normalised, most) in zip(axes, ((True, 300), (False, 30000)), strict=True):
        scenario = load_scenario(RING, **{"observer.normalised": normalised, "observer.nu": most, "run.steps": 41})
        part = island_of(scenario, scenario.graph.ids, local_estimates(scenario, scenario.options))
        x = simulate(synthesise(load_scenario(RING, **{"observer.nu": 2, "run.steps": 41}))).x[-1]
        hears = {i: scenario.graph.hears(i) for i in part.ids}
        options = {"fusion": "admm", "gamma": 0.5, "nu": most, "alpha_factor": 1.0}
        means, last = errors(part, options, hears, x, normalised)
        nu = np.arange(1, most + 1)
        S = np.linalg.cholesky(part.H).T if normalised else np.eye(len(x))
        bound = [theorem_bound(part, scenario.options, int(k), float(np.linalg.norm(S @ x))) for k in nu]
        axis.loglog(nu, bound, "k--", label="bound (17)")
        axis.loglog(nu, means, color="tab:orange", label="mean of the iterates")
        axis.loglog(nu, np.maximum(last, 1e-12), color="tab:blue", label="last iterate (the output)")
        axis.set_title("normalised" if normalised else "not normalised", fontsize=10)
        axis.set_xlabel("iterations per step")
        axis.set_ylim(1e-12, 1e3)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("largest error of a node")
    axes[0].legend(fontsize=8)
    figure.savefig(HERE / "admm_theorem1.png", dpi=90)


if __name__ == "__main__":
    main()
