"""The fusion of seed 002 on a graph that it was not designed for: a lost neighbour is taken to agree with the node."""

from __future__ import annotations

import numpy as np

from duio_mesh.geometry.stability import spectral_radius
from duio_mesh.observers.fusion import fusion_rounds, step_size
from duio_mesh.scenario.model import Graph
from duio_mesh.synthesis.admm_options import Options
from duio_mesh.synthesis.admm_rates import Island, admm_matrix, relaxed_matrix, spectrum
from duio_mesh.synthesis.design import Design
from duio_mesh.synthesis.units import even_columns

RADIUS_OF = "fusion, per exchange (0: exact after its rounds; none: it ends in something else than the state)"


def error_radius(design: Design, graph: Graph) -> float:
    """Spectral radius of the fusion's error of graph.ids; inf when the fusion does not lead to the state at all.

    Every node keeps H^-1 of its designed island, its step size or its c d_i, and the rounds. When the nodes of
    graph.ids do not see the whole state together, their common error stays and the radius is 1.
    """
    options: Options = design.scenario.options
    designed = design.scenario.graph
    home = next(ids for ids in designed.islands() if graph.ids[0] in ids)
    T = {i: design.nodes[i].matrices["T"] for i in home}
    if options.needs_H:  # then the states' units change nothing but the digits of H^-1
        s = even_columns(np.vstack(list(T.values())))
        T = {i: part * s for i, part in T.items()}
    H = sum((T[i].T @ T[i] for i in home), np.zeros_like(design.scenario.plant.A))
    left = Island(graph.ids, tuple(T[i] for i in graph.ids), graph.laplacian(), H, np.asarray(np.linalg.inv(H)))
    degrees = np.array([sum(designed.hears(i).values()) for i in graph.ids])
    if options.fusion == "finite_time":  # its eigenvalues and its N belong to the designed island
        same = graph.ids == home and np.array_equal(degrees, left.degrees)
        return 0.0 if same else float("inf")
    if options.fusion == "relaxed":
        return spectral_radius(relaxed_matrix(left, options.c, degrees))
    inverse = left.inverse if options.normalised else None
    steps = [step_size(part, inverse, options.gamma, d) for part, d in zip(left.T, degrees, strict=True)]
    return spectral_radius(admm_matrix(left, options, options.alpha_factor * np.array(steps)))


def error_left(design: Design, graph: Graph) -> float:
    """About what is left of the fusion's error after the rounds of one step: radius to their power."""
    options: Options = design.scenario.options
    designed = design.scenario.graph
    home = next(ids for ids in designed.islands() if graph.ids[0] in ids)
    at = [designed.ids.index(i) for i in home]
    eigenvalues = spectrum(designed.laplacian()[np.ix_(at, at)])
    return error_radius(design, graph) ** fusion_rounds({**options.model_dump(), "eigenvalues": eigenvalues})
