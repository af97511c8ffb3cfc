"""Nodes that are killed, restarted and paused as planned: the mesh equals the oracle, bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import duio_mesh
from duio_mesh import cli
from duio_mesh.arrays import Array
from tests.conftest import TOPOLOGIES

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

STEPS = 40
PAUSE = {"node": 1, "pause": 6, "seconds": 0.2}
DEGRADE = {"nodes": [{"node": 2, "kill": 10}, PAUSE]}
APART = {"nodes": [{"node": 2, "restart": 8, "away": 9}, {"node": 1, "restart": 12, "away": 11}, PAUSE]}
TOGETHER = {"nodes": [{"node": 2, "restart": 8, "away": 8}, {"node": 1, "restart": 12, "away": 4}]}
GLOBAL = {"observer.setup": "global"}
PLANS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "degrade": ({"run.on_node_loss": "degrade"}, DEGRADE),
    "warm": ({"run.on_node_loss": "restart"}, APART),
    "warm together": ({"run.on_node_loss": "restart"}, TOGETHER),
    "cold": ({"run.on_node_loss": "restart", "run.rejoin": "cold"}, APART),
    "cold together": ({"run.on_node_loss": "restart", "run.rejoin": "cold"}, TOGETHER),
}
CASES: list[tuple[str, str, dict[str, Any]]] = [
    *(("ring", plan, {}) for plan in PLANS),
    ("augmented_example9", "degrade", {}),
    ("augmented_example9", "cold", {}),
    ("augmented_directed", "warm together", {}),
    ("augmented_directed", "degrade", {}),
    ("admm_ring", "degrade", {}),
    ("admm_ring", "warm", {}),
    ("admm_ring", "cold together", {}),
    ("finite_time_ring", "degrade", GLOBAL),
    ("finite_time_ring", "warm", GLOBAL),
    ("relaxed_ring", "cold", {}),
    ("relaxed_ring", "warm together", {}),
    ("geometric_ring", "degrade", {}),
    ("geometric_ring", "warm", {}),
    ("reduced_order_kundur8", "cold together", {}),
    ("reduced_order_kundur8", "warm", {}),
    ("partitioned", "degrade", {}),
    ("partitioned", "warm", {}),
]
KILLED = {"degrade": [2]}


def design_of(name: str, faults: dict[str, Any], **changes: Any) -> Any:
    changes = {"run.steps": STEPS, "run.deadline": 30.0} | changes
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes, faults=faults))


def same(design: Any, folder: str = "run") -> duio_mesh.RunResult:
    """Run it both ways, compare every bit, and see that everything planned did happen to real processes."""
    expected = duio_mesh.simulate(design).arrays()
    result = duio_mesh.run(design, folder, record=False)
    found = result.trace.arrays()
    assert found.keys() == expected.keys()
    for array, values in expected.items():
        assert found[array].tobytes() == values.tobytes(), array
    faults = design.scenario.faults
    gone, events = [f for f in faults.nodes if f.what != "pause"], result.metrics["events"]
    assert {(e["who"], e["k"]) for e in events if e["event"] == "dying"} == {(f"node-{f.node}", f.step) for f in gone}
    assert {(e["who"], e["k"]) for e in events if e["event"] == "back"} == {
        (f"node-{f.node}", f.step + f.away) for f in gone if f.what == "restart"
    }
    paused = [f for f in faults.nodes if f.what == "pause"]
    assert sorted(e["event"] for e in events if e["event"] in ("pausing", "resumed")) == sorted(
        ["pausing", "resumed"] * len(paused)
    )
    missing = np.asarray(np.isnan(result.trace.xhat[:, :, 0]))
    for at, i in enumerate(design.nodes):  # rows are missing exactly where the process was away
        spans = faults.absences(i)
        assert missing[at].tolist() == [any(a <= k < b for a, b in spans) for k in range(design.plant.steps)]
    return result


@pytest.mark.parametrize(("name", "plan", "changes"), CASES, ids=[f"{name}-{plan}" for name, plan, _ in CASES])
def test_the_mesh_equals_the_oracle(name: str, plan: str, changes: dict[str, Any]) -> None:
    policy, faults = PLANS[plan]
    same(design_of(name, faults, **policy, **changes))


def test_together_with_loss_and_delay() -> None:
    """A frame on its long way when a process dies, and frames held back for one that has just begun."""
    links = [{"loss": 0.2, "delay": {"steps": [0, 3]}, "reorder": 0.1, "duplicate": 0.1, "corrupt": 0.05}]
    result = same(design_of("ring", APART | {"links": links}, **{"run.on_node_loss": "restart"}))
    assert all(result.metrics["faults"][what] > 0 for what in ("lost", "late"))


def test_in_batches() -> None:
    """A process comes and goes between two blocks."""
    faults = {"nodes": [{"node": 2, "restart": 8, "away": 12}, {"node": 3, "restart": 12, "away": 4}]}
    same(design_of("relaxed_ring", faults, **{"run.on_node_loss": "restart", "run.batch": 4}))


def test_every_node_at_once_and_twice() -> None:
    """Nobody is left to tell anything: all begin from nothing, flagged, and converge again."""
    everybody = [{"node": i, "restart": 6, "away": 5} for i in (1, 2, 3, 4)]
    result = same(
        design_of(
            "ring", {"nodes": [*everybody, {"node": 3, "restart": 20, "away": 7}]}, **{"run.on_node_loss": "restart"}
        )
    )
    assert result.trace.flagged is not None
    assert result.trace.flagged[:, 11].all()


def test_from_the_first_step_and_to_the_last() -> None:
    """Away at step 0, so that nobody has an estimate to tell; back in the very last step."""
    faults = {"nodes": [{"node": 1, "restart": 0, "away": 3}, {"node": 4, "restart": 30, "away": STEPS - 31}]}
    same(design_of("ring", faults, **{"run.on_node_loss": "restart"}))


@pytest.mark.parametrize("mode", ["password", "mtls"])
def test_a_process_that_comes_back_uses_the_credentials_of_its_node(mode: str) -> None:
    design = design_of("ring", APART, **{"run.on_node_loss": "restart", "security": mode})
    result = same(design)
    assert result.metrics["rejected"] == {}
    assert not (result.folder / "keys").exists()


def test_the_tape_of_a_node_that_was_restarted(capsys: pytest.CaptureFixture[str]) -> None:
    """Replayed alone, it gives every bit that its two processes gave; a neighbour's tape knows when it was missing."""
    design = design_of("ring", APART, **{"run.on_node_loss": "restart", "run.inputs": True})
    result = same(design)
    for i in (2, 3):
        assert cli.main(["replay", str(result.folder), "--node", str(i), "--out", f"{i}.npz"]) == 0
        assert "bit for bit" in capsys.readouterr().out
        with np.load(f"{i}.npz", allow_pickle=False) as replayed:
            found: Array = replayed["xhat"]
        kept = result.trace.xhat[list(design.nodes).index(i)]
        assert found.tobytes() == kept[~np.isnan(kept).any(axis=1)].tobytes()
