"""Nodes that are lost while the samples come from outside: the others go on, and who comes back is in step."""

from __future__ import annotations

import signal
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import duio_mesh
from duio_mesh import simulation
from duio_mesh.arrays import Array
from duio_mesh.report.metrics import metrics
from duio_mesh.report.record_trace import record_trace
from duio_mesh.simulation import Trace, simulate
from duio_mesh.synthesis.design import Design
from tests.conftest import wait_for
from tests.external.feeding import IDS, TOPOLOGY, Outsider, design, feeding, free_port, rooms
from tests.processes.running import Running
from tests.report.synthetic import read_series

STEPS = 30
KILLED, FIRST, BACK = 2, 8, 17  # a node, and the steps of its absence
DEGRADE = {"node": KILLED, "kill": FIRST}
RESTART = {"node": KILLED, "restart": FIRST, "away": BACK - FIRST}
PLANS = [("degrade", DEGRADE), ("restart", RESTART)]


def designed(policy: str, fault: dict[str, Any], steps: int = STEPS) -> Design:
    settings = {"run.on_node_loss": policy, "run.steps": steps, "run.deadline": 30.0}
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGY, **settings, faults={"nodes": [fault]}))


class Rows:
    """In the place of the oracle's plant: the rows of the example's file."""

    def __init__(self, _: Any) -> None:
        self.k, self.x = 0, np.full(9, np.nan)

    def sample(self) -> dict[int, Array]:
        return {i: rooms()[i][self.k] for i in IDS}

    def advance(self) -> None:
        self.k += 1


def oracle(made: Design, monkeypatch: pytest.MonkeyPatch) -> Trace:
    """What the observers make of the file's rows when their processes come and go as planned."""
    with monkeypatch.context() as patch:
        patch.setattr(simulation, "Plant", Rows)
        trace = simulate(made)
    return replace(trace, samples={i: table[: len(trace.t)] for i, table in rooms().items()})


def feed(outsider: Outsider, steps: int) -> None:
    for k in range(steps):
        outsider.row(k)
    outsider.end()


@pytest.mark.mesh
@pytest.mark.usefixtures("nothing_left")
@pytest.mark.parametrize(("policy", "fault"), PLANS)
def test_a_node_that_is_lost_as_planned_gives_the_bits_of_the_oracle(
    policy: str, fault: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All samples come at once: those that pile up while the gateway waits for who comes back are not lost."""
    made, endpoint = design(given=designed(policy, fault, steps=1000))
    assert {spec.block for spec in made.nodes.values()} == {made.plant.block} == {1}
    expected = oracle(replace(made, plant=replace(made.plant, steps=STEPS)), monkeypatch)
    with feeding(endpoint, partial(feed, steps=STEPS)):
        result = duio_mesh.run(made, "run", record=False)
    found = result.trace
    assert found.flagged is not None
    assert expected.flagged is not None
    assert found.xhat.tobytes() == expected.xhat.tobytes()
    assert found.flagged.tobytes() == expected.flagged.tobytes()
    away = np.isnan(found.xhat).any(axis=2)
    assert away[IDS.index(KILLED)].nonzero()[0].tolist() == list(range(FIRST, BACK if policy == "restart" else STEPS))
    assert away.sum(axis=1).tolist() == [0, away[1].sum(), 0, 0]
    assert all(found.samples[i].tobytes() == rooms()[i][:STEPS].tobytes() for i in IDS)  # a lost node's go on
    back = [(e["who"], e["k"]) for e in result.metrics["events"] if e["event"] == "back"]
    assert back == ([("node-2", BACK)] if policy == "restart" else [])
    assert result.metrics["rejected"] == {}


@pytest.mark.mesh
@pytest.mark.usefixtures("nothing_left")
def test_a_killed_node_is_replaced_while_the_sensors_go_on_at_their_own_pace() -> None:
    """Nobody planned it: the new process asks while no sample comes, and takes part from one of the next on."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = [f"external.listen={endpoint}", "run.on_node_loss=restart", "run.deadline=30"]
    options = [word for setting in settings for word in ("--set", setting)]

    with Running(TOPOLOGY.name, "--no-record", *options, steps=1000) as run:

        def said(event: str) -> list[dict[str, Any]]:
            return [e for e in run.said(f"node-{KILLED}") if e["event"] == event]

        def work(outsider: Outsider) -> None:
            for k in range(20):
                outsider.row(k)
            wait_for(lambda: any(e["k"] == 20 for e in said("waiting")))
            run.send(f"node-{KILLED}", signal.SIGKILL)
            for k in range(20, 25):
                outsider.row(k)
            wait_for(lambda: len(said("ready")) == 2)
            for k in range(25, 101):
                outsider.row(k)
                if not said("back"):
                    threading.Event().wait(0.05)  # the sensors' period
            outsider.end()

        with feeding(endpoint, work):
            assert run.end() == 0, run.stdout + run.stderr
        [back] = said("back")
    found = run.metrics()
    with np.load(run.out / "trace.npz", allow_pickle=False) as trace:
        away, flagged = np.isnan(trace["xhat"]).any(axis=2), trace["flagged"]
    assert away.shape == (4, 101)
    assert not away[[0, 2, 3]].any()
    [[first, after]] = found["nodes"][str(KILLED)]["lost"]
    assert first <= 20  # what it had not written yet when it was killed is lost as well
    assert 25 <= after == back["k"] < 80
    assert away[1].nonzero()[0].tolist() == list(range(first, after))
    assert not flagged[:, -1].any()
    assert found["verdict"] == "the nodes agree"
    assert "recovery" not in found  # nobody knows an error


@pytest.mark.parametrize(("policy", "fault"), PLANS)
def test_only_estimates_that_there_are_count_in_how_far_the_nodes_agree(
    policy: str, fault: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    made = designed(policy, fault)
    trace = oracle(made, monkeypatch)
    found = metrics(trace, made.scenario, {"failure": ""})
    first = found["criterion"]["from_step"]
    distances = {}
    for at, i in enumerate(IDS):
        apart, missed = [], []
        for k in range(first, STEPS):
            there = [j for j in range(4) if not np.isnan(trace.xhat[j, k]).any()]
            if at not in there:
                continue
            middle = sum(trace.xhat[j, k] for j in there) / len(there)
            apart.append(trace.xhat[at, k] - middle)
            C = made.scenario.nodes[i].C
            missed += [rooms()[i][k, : len(C)] - C @ trace.xhat[j, k] for j in there if j != at]
        node = found["nodes"][str(i)]
        if apart:
            assert node["disagreement"] == pytest.approx(np.sqrt(np.mean(np.square(apart))), rel=1e-12)
            assert node["residual"] == pytest.approx(np.sqrt(np.mean(np.square(missed))), rel=1e-12)
        else:
            assert (policy, i, node["disagreement"], node["residual"]) == ("degrade", KILLED, None, None)
        distances[i] = apart
    assert found["verdict"] != "incomplete"
    if policy == "degrade":
        assert found["remarks"][-1] == "node 2 is gone from step 8 on and not judged"
    record_trace(tmp_path / "recording.rrd", made.scenario, trace)
    for i in IDS:  # the recording's distances, in the judged steps
        steps, values = read_series(tmp_path / "recording.rrd", f"/error/node_{i}")
        late = [10**v for k, v in zip(steps, values, strict=True) if k >= first and not np.isnan(v)]
        assert late == pytest.approx([float(np.linalg.norm(d)) for d in distances[i]], rel=1e-9)


def test_a_run_that_loses_a_node_and_fails_is_incomplete(monkeypatch: pytest.MonkeyPatch) -> None:
    made = designed("degrade", DEGRADE)
    found = metrics(oracle(made, monkeypatch), made.scenario, {"failure": "lost"})
    assert found["verdict"] == "incomplete"
