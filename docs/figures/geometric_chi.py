"""The figure of docs/observers/geometric.md: seed 003's example above its own bound on chi.

Run from the repository: python docs/figures/geometric_chi.py
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.scenario.model import Scenario
from duio_mesh.synthesis.design import Design
from duio_mesh.synthesis.geometric import bounds_21
from duio_mesh.synthesis.geometric_local import LocalUio, local_uio
from duio_mesh.synthesis.sampled import abscissa, error_system

HERE = Path(__file__).parent
GRAPHS = {
    "ring 1-2-3-4": [[1, 2], [2, 3], [3, 4], [4, 1]],
    "path 1-2-3-4": [[1, 2], [2, 3], [3, 4]],
    "star around 1": [[1, 2], [1, 3], [1, 4]],
    "path 2-1-3-4": [[2, 1], [1, 3], [3, 4]],
    "path 2-1-4-3": [[2, 1], [1, 4], [4, 3]],
    "path 3-1-2-4": [[3, 1], [1, 2], [2, 4]],
}


def load(graph: str, **options: object) -> Scenario:
    path = HERE.parents[1] / "topologies" / "geometric_ring.yaml"
    return load_scenario(path, **{"graph.edges": GRAPHS[graph], **options})


def locals_of(scenario: Scenario) -> dict[int, LocalUio]:
    o = scenario.options
    return {
        i: local_uio(s.C, scenario.plant.A, scenario.known(i), scenario.unknown(i), o.poles, o.kappa, f"node {i}")
        for i, s in scenario.nodes.items()
    }


def with_chi(design: Design, chi: float) -> Design:
    """The same design with a coupling gain that the synthesis would refuse."""
    nodes = {i: dataclasses.replace(s, options={**s.options, "chi": chi}) for i, s in design.nodes.items()}
    return dataclasses.replace(design, nodes=nodes)


def main() -> None:
    fig, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.6), constrained_layout=True)
    gains = np.geomspace(1, 1000, 241)
    for graph in GRAPHS:
        scenario = load(graph)
        nodes, L = locals_of(scenario), scenario.graph.laplacian()
        growth = lambda chi, n=nodes, at=L: abscissa(error_system([v.coupled(chi) for v in n.values()], at))  # noqa: E731
        style = "--" if graph == "path 2-1-4-3" else "-"  # the same curve as path 2-1-3-4, another bound
        (line,) = left.semilogx(gains, [growth(chi) for chi in gains], style, lw=1.2, label=graph)
        bound = bounds_21(scenario, nodes)["chi_bound_21"] or np.nan
        left.plot(1.05 * bound, growth(1.05 * bound), "o", color=line.get_color(), ms=5)
    left.axhline(0, color="black", lw=0.8)
    left.set(
        xlabel="coupling gain χ (1/s)", ylabel="largest real part (1/s)", title="Error system; dots: 1.05 × bound (21)"
    )
    left.legend(fontsize=7)

    graph, run = "path 3-1-2-4", {"run.step": 0.001, "run.steps": 20001}
    stable, damped = synthesise(load(graph, **run)), synthesise(load(graph, **run, **{"observer.kappa": 10}))
    above = 1.05 * stable.certificate["chi_bound_21"]
    for label, design in (
        (f"χ = {above:.0f}, 1.05 × bound (21)", with_chi(stable, above)),
        (f"χ = {above:.0f}, κ = 10", with_chi(damped, above)),
        ("χ = 10", stable),
    ):
        trace = simulate(design)
        error = np.linalg.norm(trace.xhat - trace.x, axis=2).max(axis=0)
        right.semilogy(trace.t[::20], error[::20], lw=1.2, label=label)
    right.set(xlabel="time (s)", ylabel="largest |x̂ᵢ - x|", title=f"{graph}, exchange every 1 ms")
    right.legend(fontsize=7)
    fig.savefig(HERE / "geometric_chi.png", dpi=90)


if __name__ == "__main__":
    main()
