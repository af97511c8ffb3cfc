"""Batches: W steps fused as one block of n x W numbers per round. The estimates are the same bits for every W."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import duio_mesh
from duio_mesh.errors import DesignError
from duio_mesh.trace import Trace
from tests.conftest import TOPOLOGIES

STEPS = 130  # 64 goes into it twice with a rest, 7 eighteen times with a rest


def run(name: str, batch: int, **more: object) -> Trace:
    options = {"run.steps": STEPS, "run.batch": batch, **more}
    return duio_mesh.simulate(duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **options)))


@cache
def step_by_step(name: str) -> bytes:
    return run(name, 1).xhat.tobytes()


@pytest.mark.parametrize("name", ["admm_ring", "finite_time_ring", "relaxed_ring", "admm_partitioned"])
@pytest.mark.parametrize("batch", [2, 7, 64, STEPS, 1000])
def test_the_oracle_gives_the_same_bits_for_every_batch(name: str, batch: int) -> None:
    assert run(name, batch).xhat.tobytes() == step_by_step(name)


def test_a_distributed_set_up_comes_before_the_first_batch() -> None:
    alone, batched = (run("finite_time_ring", W, **{"observer.setup": "distributed"}) for W in (1, 16))
    assert alone.xhat.tobytes() == batched.xhat.tobytes()


@pytest.mark.mesh
@pytest.mark.usefixtures("nothing_left")
@pytest.mark.parametrize("batch", [1, 2, 7, 64])
def test_the_mesh_in_batches_equals_the_oracle_step_by_step(batch: int) -> None:
    options = {"run.steps": STEPS, "run.batch": batch}
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "finite_time_ring.yaml", **options)
    result = duio_mesh.run(duio_mesh.synthesise(scenario), "run", record=False)
    assert result.trace.xhat.tobytes() == step_by_step("finite_time_ring")
    blocks = -(-STEPS // batch)
    assert result.metrics["rounds"] == 2 * blocks + 2  # and two in which the nodes find H
    assert np.array_equal(result.trace.node_ids, [1, 2, 3, 4])


def test_a_method_with_memory_between_exchanges_refuses_batches() -> None:
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml", **{"run.batch": 2})
    with pytest.raises(DesignError, match=r"run\.batch: lmi needs each step's exchange"):
        duio_mesh.synthesise(scenario)
