"""Which g each island of the LMI observer gets, and why one gets none (seed 000, section 5.3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from duio_mesh.errors import DesignError
from duio_mesh.geometry.stability import SCHUR
from duio_mesh.scenario.model import Graph, Scenario
from duio_mesh.synthesis.consensus import Coupling, Undetectable, couple, coupling, pencil_of
from duio_mesh.synthesis.design import Progress
from duio_mesh.synthesis.eigenvalue import Say, minimise_largest_eigenvalue
from duio_mesh.synthesis.lmi_network import Local, Network
from duio_mesh.synthesis.losses import losses, without
from duio_mesh.synthesis.pencil import Pencil
from duio_mesh.synthesis.spectral import least_radius

Island = tuple[int, ...]

CLEAR = 1 - SCHUR
"""How far beta_u has to be below 0 to be more than rounding."""


def couple_islands(scenario: Scenario, nodes: Mapping[int, Local], progress: Progress) -> Network:
    """g, island by island: (38) is the maximum over islands, so each may take its own best without raising it.

    Raises DesignError when an island has no g of the wanted kind; the message says by how much it fails.
    """
    g: dict[int, float] = {}
    islands: dict[Island, Coupling] = {}
    for island in scenario.graph.islands():

        def say(what: str, at: Island = island) -> None:
            progress(f"coupling of {_who(at)}: {what}")

        found = _gains(scenario, island, nodes, say)
        islands[island] = found
        g |= dict(zip(island, map(float, found.g), strict=True))
    return Network(nodes, {i: g[i] for i in nodes}, islands)


def _gains(scenario: Scenario, island: Island, nodes: Mapping[int, Local], say: Say) -> Coupling:
    options: Any = scenario.options
    laplacian = _laplacian(scenario.graph, island)
    if options.consensus == "robust":
        return _robust(scenario, island, nodes, say)
    found = couple(_parts(island, nodes), laplacian, "paper" if options.consensus == "paper" else "norm", say)
    if options.consensus == "schur":
        return _schur(island, found, say)
    if not found.beta < -CLEAR:  # instead of (40): the sign also says by how much
        raise DesignError(_infeasible(island, found, nodes, options))
    return found


def _parts(island: Island, nodes: Mapping[int, Local]) -> list[Undetectable]:
    return [Undetectable(nodes[i].parts.U.T @ nodes[i].A @ nodes[i].parts.U, nodes[i].parts.U) for i in island]


def _pencil(island: Island, nodes: Mapping[int, Local], graph: Graph) -> Pencil:
    return pencil_of(_parts(island, nodes), _laplacian(graph, island), "norm")


def _laplacian(graph: Graph, island: Island) -> Any:
    rows = [graph.ids.index(i) for i in island]
    return graph.laplacian()[np.ix_(rows, rows)]


def _schur(island: Island, start: Coupling, say: Say) -> Coupling:
    """A g whose Phi_u is Schur, whatever its norm."""
    g, radius = least_radius(start.pencil, start.g, say)
    if not radius < SCHUR:
        raise DesignError(
            f"consensus: schur found no stabilising gains for {_who(island)}: the least spectral radius of Phi_u found "
            f"is {radius:.6g} (a search, not a proof that none exist). {_advice(island)}{_exact(island)}."
        )
    return coupling(g, None, start.lower, start.pencil)


def _robust(scenario: Scenario, island: Island, nodes: Mapping[int, Local], say: Say) -> Coupling:
    """The g with the least largest ||Phi_u|| over the island's graph and those with one edge lost."""
    whole = scenario.graph
    graphs = {"nothing lost": whole} | {
        f"{loss.words(whole)} lost": without(whole, loss)
        for loss in losses(whole, 1)
        if loss.links and loss.links[0][0] in island
    }
    pencils = {name: _pencil(island, nodes, graph) for name, graph in graphs.items()}
    best = minimise_largest_eigenvalue(list(pencils.values()), say)
    if not best.value < SCHUR:
        alone = {}
        for name, pencil in pencils.items():
            say(f"{name}, on its own")
            alone[name] = minimise_largest_eigenvalue([pencil]).lower - 1
        hopeless = {name: beta for name, beta in alone.items() if beta >= -CLEAR}
        if hopeless:
            cause = "impossible whatever the others ask: " + _listed(hopeless)
        else:
            size = {name: coupling(best.g, None, -1.0, pencil).beta for name, pencil in pencils.items()}
            cause = "each is possible alone, but not together; at the best compromise: " + _listed(
                {name: beta for name, beta in size.items() if beta >= 0.99 * (best.value - 1)}
            )
        raise DesignError(
            f"consensus: robust is infeasible on {_who(island)}: no g makes the sum of |U_i'e_i|^2 fall in every step "
            f"of the graph and of every graph with one edge lost (least common beta_u = {best.value - 1:+.3g}); "
            f"{cause}. Add edges, or use consensus: norm and look at --check --contingency 1, which asks for "
            "eigenvalues only."
        )
    return coupling(best.g, best.value - 1, best.lower - 1, pencils["nothing lost"])


def _listed(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name} (beta_u = {value:+.3g})" for name, value in values.items())


def _who(island: Island) -> str:
    if len(island) == 1:
        return f"node {island[0]}, which hears nobody"
    return f"nodes {', '.join(map(str, island))}" if len(island) <= 8 else f"{len(island)} nodes from {island[0]}"


def _advice(island: Island) -> str:
    if len(island) == 1:
        return "No other node's estimate corrects it: let it hear a node, measure more or know more inputs"
    return "To change it: add edges or measurements; let nodes know more inputs"


def _exact(island: Island) -> str:
    """A node alone has no coupling to choose: what it cannot see, it cannot see with any method."""
    return "; or use method: augmented, whose condition is exact" if len(island) > 1 else ""


def _infeasible(island: Island, found: Coupling, nodes: Mapping[int, Local], options: Any) -> str:
    criterion = "(38)-(39)" if options.consensus == "paper" else "min ||A_u - Theta(g)||_2^2 - 1"
    dimensions = ", ".join(str(nodes[i].parts.nu) for i in island)
    size = "> 0" if found.beta > CLEAR else "not below 0 by more than rounding,"
    advice = _advice(island)
    if options.decomposition == "observability":
        advice += "; try decomposition: detectability, which leaves less to the neighbours"
    if len(island) > 1:
        advice += "; try consensus: schur, which asks for stability only"
    return (
        f"the consensus design is infeasible: beta_u = {found.beta:+.3g} {size} on {_who(island)} (the least value of "
        f"{criterion}, lower bound {found.lower:+.3g}; nu = {dimensions}). It asks more than stability: that the sum "
        f"of |U_i'e_i|^2 falls in every step. {advice}{_exact(island)}."
    )
