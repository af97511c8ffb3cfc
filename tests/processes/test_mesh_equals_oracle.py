"""The mesh against the oracle, bit for bit: every topology, three seeds."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import duio_mesh
from duio_mesh.synthesis.design import Design
from tests.conftest import TOPOLOGIES, simulated

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

STEPS, SEEDS = 40, (0, 1, 2)
SLOW = {"admm_plain": (1, (0,))}  # 30,000 rounds a step
NAMES = simulated()


@cache
def design_of(name: str) -> Design:
    return duio_mesh.synthesise(
        duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **{"run.steps": SLOW.get(name, (STEPS,))[0]})
    )


def with_seed(design: Design, seed: int) -> Design:
    """The same gains, another initial state and other noise."""
    return replace(design, plant=replace(design.plant, seed=seed))


@pytest.mark.parametrize("name", NAMES)
def test_the_mesh_equals_the_oracle_bit_for_bit(name: str) -> None:
    for seed in SLOW.get(name, (STEPS, SEEDS))[1]:
        design = with_seed(design_of(name), seed)
        expected = duio_mesh.simulate(design).arrays()
        result = duio_mesh.run(design, f"run-{seed}", record=False)
        found = result.trace.arrays()
        assert found.keys() == expected.keys()
        for array, values in expected.items():
            assert found[array].tobytes() == values.tobytes(), f"{array}, seed {seed}"
        assert result.metrics["steps"] == design.plant.steps
        assert result.metrics["rejected"] == {}


def test_the_same_seed_twice_gives_the_same_hash_and_another_seed_another() -> None:
    design = design_of("partitioned")
    seeds = (3, 3, 4)
    hashes = [
        duio_mesh.run(with_seed(design, s), f"run-{n}", record=False).metrics["estimates_sha256"]
        for n, s in enumerate(seeds)
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_a_recorded_run_has_every_file_and_the_recording_every_row() -> None:
    from rerun.chunk import RrdReader

    design = design_of("ring")
    result = duio_mesh.run(design, "run")
    names = {str(p.relative_to(result.folder)) for p in result.folder.rglob("*") if p.is_file()}
    processes = ["node-1", "node-2", "node-3", "node-4", "plant", "recorder"]
    assert names == {
        "scenario.yaml",
        "certificate.json",
        "trace.npz",
        "recording.rrd",
        "metrics.json",
        *(f"nodes/{who}.spec" for who in processes),
        *(f"logs/{who}.jsonl" for who in processes),
    }
    assert json.loads((result.folder / "certificate.json").read_text())["spectral_radius"] < 1
    assert result.warnings == ()
    entities = {chunk.entity_path for chunk in RrdReader(result.folder / "recording.rrd").stream()}
    assert any("node-1" in str(e) or "/1" in str(e) for e in entities), entities


def test_the_resolved_scenario_runs_to_the_same_bits() -> None:
    design = design_of("star")
    first = duio_mesh.run(design, "first", record=False)
    again = duio_mesh.synthesise(duio_mesh.load_scenario(Path("first/scenario.yaml")))
    assert np.array_equal(duio_mesh.simulate(again).xhat, first.trace.xhat)
