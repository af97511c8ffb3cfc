"""The mesh under faults equals the oracle under the same faults, bit for bit, and the faults really happen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import duio_mesh
from tests.conftest import TOPOLOGIES
from tests.report.synthetic import read_texts

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

EVERYTHING = {
    "loss": 0.1,
    "gilbert_elliott": {"worsen": 0.05, "mend": 0.3},
    "delay": {"steps": [0, 2]},
    "duplicate": 0.2,
    "reorder": 0.1,
    "corrupt": 0.05,
}
FAULTS: dict[str, dict[str, Any]] = {
    "everything": {"links": [EVERYTHING]},
    "loss": {"links": [{"loss": 0.3}]},
    "delay": {"links": [{"delay": {"steps": 1}}]},
    "rounds": {"links": [{"delay": {"rounds": [0, 3]}}]},
    "silence": {"links": [{"loss": 1.0}]},
}
METHODS = ["ring", "augmented_example9", "augmented_directed", "admm_ring", "relaxed_ring", "geometric_ring"]


def design_of(name: str, faults: dict[str, Any], **changes: Any) -> Any:
    changes = {"run.steps": 40} | changes
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes, faults=faults))


def same(design: Any) -> duio_mesh.RunResult:
    """Run it both ways; the mesh's result."""
    oracle = duio_mesh.simulate(design)
    expected = oracle.arrays()
    result = duio_mesh.run(design, "run", record=False)
    found = result.trace.arrays()
    assert found.keys() == expected.keys()
    for array, values in expected.items():
        assert found[array].tobytes() == values.tobytes(), array
    assert oracle.flagged is not None
    counted = {str(i): int(flags.sum()) for i, flags in zip(oracle.node_ids, oracle.flagged, strict=True)}
    assert {i: node["flagged"] for i, node in result.metrics["nodes"].items()} == counted
    assert sum("flags" in warning for warning in result.warnings) == sum(count > 0 for count in counted.values())
    return result


@pytest.mark.parametrize("name", METHODS)
def test_every_method_under_everything(name: str) -> None:
    result = same(design_of(name, FAULTS["everything"]))
    refused = result.metrics["rejected"]
    faults = result.metrics["faults"]
    assert all(faults[what] > 0 for what in ("lost", "corrupt", "late", "duplicate"))
    assert "checksum" in str(refused)  # flipped bits are caught by the frame check
    assert "seen before" in str(refused)  # and second copies dropped


@pytest.mark.parametrize("fault", ["loss", "delay", "rounds", "silence"])
def test_every_kind_alone(fault: str) -> None:
    assert same(design_of("ring", FAULTS[fault])).metrics["rejected"] == {}


def test_finite_time_predicts_the_same() -> None:
    same(design_of("finite_time_ring", FAULTS["loss"], **{"observer.setup": "global"}))


def test_a_cut_and_what_waits_behind_it() -> None:
    """An island may be a whole window ahead when the edge heals, with many rounds a step."""
    edges = [[1, 2], [1, 3]]
    cut = {"cuts": [{"edges": edges, "during": [5, 35]}]}
    same(design_of("admm_ring", cut, **{"run.window": 4}))


def test_batches() -> None:
    same(design_of("relaxed_ring", FAULTS["everything"], **{"run.batch": 4}))


def test_the_faults_have_a_seed_of_their_own() -> None:
    one, same_again, other = (
        duio_mesh.run(design_of("ring", FAULTS["loss"] | {"seed": s}), f"run-{n}", record=False)
        for n, s in enumerate((1, 1, 2))
    )
    assert one.metrics["estimates_sha256"] == same_again.metrics["estimates_sha256"]
    assert one.metrics["estimates_sha256"] != other.metrics["estimates_sha256"]


def test_the_recording_shows_every_flag_and_the_metrics_the_last_ones() -> None:
    """A cut that does not heal: the lanes of the recording are the oracle's flags, and the verdict says so."""
    faults = {"links": [{"loss": 0.1}], "cuts": [{"edges": [[1, 2]], "during": [10, 40]}]}
    design = design_of("ring", faults, **{"run.convergence.rms_below": 1e9})
    flagged = duio_mesh.simulate(design).flagged
    result = duio_mesh.run(design, "run")
    assert flagged is not None
    for at, i in enumerate(design.nodes):
        changes = dict(read_texts(result.folder / "recording.rrd", f"/flag/node_{i}", "StateChange:state"))
        turns = np.flatnonzero(np.diff(flagged[at], prepend=not flagged[at, 0])).tolist()
        assert changes == {k: "flagged" if flagged[at, k] else "trusted" for k in turns}
        last = len(flagged[at]) - 1 - int(np.flatnonzero(~flagged[at])[-1])
        assert last > 10
        assert result.metrics["nodes"][str(i)]["flagged_last"] == last
    assert result.metrics["verdict"] == "converged"
    (remark,) = result.metrics["remarks"]
    assert remark.startswith("nodes 1, 2, 3 and 4 flag their last ")
