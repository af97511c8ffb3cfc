"""A node that is killed and comes back, in the oracle: against the paper's recursion, and against the certificate."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import duio_mesh
from duio_mesh.arrays import Array
from duio_mesh.observers.absence import PATIENCE
from duio_mesh.trace import Trace
from tests.faults.test_oracle import design_of, errors

DEGRADE: dict[str, Any] = {"run.on_node_loss": "degrade"}


def restart(rejoin: str = "warm") -> dict[str, Any]:
    return {"run.on_node_loss": "restart", "run.rejoin": rejoin}


@pytest.mark.parametrize("rejoin", ["warm", "cold"])
def test_the_lmi_observer_without_a_node_and_with_it_again(rejoin: str) -> None:
    """(16) and (17) for all nodes stacked, with the Laplacian of those who are there.

    A node that comes back at step b has the xi(b) that one step without neighbours gives from the mean of its
    neighbours' x-hat(b-1), or zero.
    """
    a, b, lost = 15, 33, 3
    faults = {"nodes": [{"node": lost, "restart": a, "away": b - a}]}
    design = design_of("ring", faults, **{"run.steps": 60}, **restart(rejoin))
    trace, scenario = duio_mesh.simulate(design), design.scenario
    ids, n, names = list(design.nodes), scenario.plant.n, scenario.plant.inputs
    matrices = [design.nodes[i].matrices for i in ids]
    C = [scenario.nodes[i].C for i in ids]
    known = [[names.index(name) for name in names if name in scenario.nodes[i].knows] for i in ids]
    N, E = (_diagonal([m[name] for m in matrices]) for name in "NE")
    L, G = (_diagonal([m[name] for m in matrices]) for name in "LG")
    M = np.vstack([_columns(m["M"], columns, len(names)) for m, columns in zip(matrices, known, strict=True)])
    adjacency = np.zeros((4, 4))
    for arc in scenario.graph.arcs:
        adjacency[ids.index(arc.target), ids.index(arc.source)] = arc.weight
    F, at, everybody = design.plant.feedback, ids.index(lost), np.vstack(C)
    xi, xhat = np.zeros(4 * n), np.zeros(4 * n)
    for k, x in enumerate(trace.x):
        there = np.ones(4)
        there[at] = not a <= k < b
        if k == b:
            mean = np.zeros(n)
            own = slice(at * n, (at + 1) * n)
            if rejoin == "warm":
                mean = np.mean([xhat[j * n : (j + 1) * n] for j in range(4) if adjacency[at, j]], axis=0)
                before = trace.x[k - 1]
                u = F["F"] @ (before - F["reference"])
                y = C[at] @ before
                one = matrices[at]
                xi[own] = one["N"] @ (mean + one["E"] @ y) + one["L"] @ y + one["M"] @ u[known[at]]
            else:
                xi[own] = 0.0
        y = everybody @ x
        u = F["F"] @ (x - F["reference"])
        xhat = xi - E @ y
        for row in range(4):
            found = trace.xhat[row, k]
            assert there[row] or np.isnan(found).all()
            assert not there[row] or np.allclose(found, xhat[row * n : (row + 1) * n], rtol=0, atol=1e-9), (k, row)
        now = adjacency * np.outer(there, there)
        laplacian = np.diag(now.sum(axis=1)) - now
        xi = N @ xi + L @ y + M @ u - G @ np.kron(laplacian, np.eye(n)) @ xhat


def _diagonal(blocks: list[Array]) -> Array:
    """Blocks along the diagonal."""
    rows, columns = (np.cumsum([0, *(block.shape[axis] for block in blocks)]) for axis in (0, 1))
    found: Array = np.zeros((rows[-1], columns[-1]))
    for block, r, c in zip(blocks, rows, columns, strict=False):
        found[r : r + block.shape[0], c : c + block.shape[1]] = block
    return found


def _columns(M: Array, known: list[int], m: int) -> Array:
    """M for all inputs: zero where the node does not know them."""
    found: Array = np.zeros((M.shape[0], m))
    found[:, known] = M
    return found


LOSSES = [
    ("ring", {"plant.noise": 0, "run.steps": 500}, 1e-6),
    ("partitioned", {"plant.noise": 0, "run.steps": 500}, 1e-6),
    ("augmented_example9", {}, 1e-8),
    ("augmented_directed", {}, 1e-8),
    ("six_state_ring", {"plant.noise": 0, "run.steps": 400}, 1e-6),
    ("relaxed_ring", {"run.steps": 40}, None),
]


@pytest.mark.parametrize(("name", "changes", "level"), LOSSES, ids=[name for name, _, _ in LOSSES])
def test_the_certificate_says_what_happens(name: str, changes: dict[str, Any], level: float | None) -> None:
    """Every node is lost once. Whom the certificate lets go is not missed: errors go to zero, and nobody flags.

    Otherwise every survivor of the island in question that had heard it says so in the end: errors grow or stay.
    """
    certificate = design_of(name, None, **DEGRADE, **changes).certificate["node_loss"]
    found = {True: 0, False: 0}
    for i, case in certificate.items():
        design = design_of(name, {"nodes": [{"node": i, "kill": 10}]}, **DEGRADE, **changes)
        trace = duio_mesh.simulate(design)
        assert trace.flagged is not None
        end = slice(3 * len(trace.t) // 4, None)
        excused = [j for j, spec in design.nodes.items() if i in spec.excuses]
        left = [j for j in design.nodes if j != i]
        failing = {j for island in case["failing"] for j in island}
        assert case["reconstructs"] == (not failing)
        e = errors(trace)
        for j in left:
            row = trace.node_ids.tolist().index(j)
            bad = bool(trace.flagged[row, end].all())
            heard = i in design.nodes[j].hears
            if heard:
                assert bad == (j not in excused), (i, j)
                found[not bad] += 1
            if level is not None and j not in failing:
                assert e[row, end].max() < level, (i, j)
            if level is not None and j in failing and heard:
                assert bad, (i, j)
    assert found[True] or name == "six_state_ring"


def test_two_losses_are_more_than_the_certificate_speaks_of() -> None:
    """Each alone is allowed for; both at once are not, and whoever misses both says so."""
    changes = {"plant.noise": 0, "run.steps": 120}
    one = duio_mesh.simulate(design_of("ring", {"nodes": [{"node": 1, "kill": 10}]}, **DEGRADE, **changes))
    kills = [{"node": 1, "kill": 10}, {"node": 3, "kill": 30}]
    two = duio_mesh.simulate(design_of("ring", {"nodes": kills}, **DEGRADE, **changes))
    assert one.flagged is not None
    assert two.flagged is not None
    assert not one.flagged.any()
    assert not two.flagged[:, : 30 + PATIENCE].any()
    assert two.flagged[[1, 3], 30 + PATIENCE :].all()  # nodes 2 and 4 hear nobody else


def test_a_cold_start_is_flagged_for_as_long_as_the_certificate_says() -> None:
    changes = {"plant.noise": 0, "run.steps": 300}
    faults = {"nodes": [{"node": 3, "restart": 50, "away": 10}]}
    cold, warm = (duio_mesh.simulate(design_of("ring", faults, **restart(how), **changes)) for how in ("cold", "warm"))
    settling = design_of("ring", faults, **restart(), **changes).nodes[3].settling
    assert cold.flagged is not None
    assert warm.flagged is not None
    assert cold.flagged[2, 60 : 60 + settling].sum() >= settling - 1
    assert not cold.flagged[:, 60 + settling + 4 :].any()
    assert not warm.flagged.any()
    assert silent(cold) <= 1e-3 * errors(cold)[2, 60] + 1e-9
    assert errors(warm)[2, 60] < 0.1 * errors(cold)[2, 60]  # which is what being told is for


def silent(trace: Trace) -> float:
    """The worst error without a flag of node 3, once it is back."""
    assert trace.flagged is not None
    return float(np.where(trace.flagged, 0.0, errors(trace))[2, 60:].max())
