"""Real runs on the wall clock. How fast this machine is today decides nothing: counts and order are looked at."""

from __future__ import annotations

import json
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import duio_mesh
from tests.conftest import TOPOLOGIES, wait_for
from tests.processes.running import Running
from tests.processes.test_mesh_under_faults import EVERYTHING

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

STEPS = 6
METHODS: dict[str, dict[str, Any]] = {
    "ring": {},
    "augmented_directed": {},
    "relaxed_ring": {"observer.rounds": 10},
    "finite_time_ring": {},  # sets itself up in step 0
    "geometric_ring": {},
    "reduced_order_kundur8": {},
}


def run(name: str, tick: float, **changes: Any) -> tuple[duio_mesh.RunResult, duio_mesh.Trace]:
    """The run, and the oracle."""
    timing = {"mode": "realtime", "tick": tick, "wait": 0.9}
    changes = {"run.steps": STEPS, "timing": timing} | changes
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes))
    return duio_mesh.run(design, f"run-{tick}", record=False), duio_mesh.simulate(design)


def punctual(name: str, **changes: Any) -> tuple[duio_mesh.RunResult, duio_mesh.Trace]:
    """A run in which nothing was late, on a clock as slow as that takes; and the oracle."""
    for tick in (0.06, 0.3, 1.5):
        result, oracle = run(name, tick, **changes)
        nodes = result.metrics["timing"]["nodes"].values()
        if not any(node["late"] or node["missing"] for node in nodes):
            return result, oracle
    pytest.fail("this machine cannot bring a message from one process to another in a second")


def same(result: duio_mesh.RunResult, oracle: duio_mesh.Trace) -> None:
    found, expected = result.trace.arrays(), oracle.arrays()
    assert found.keys() == expected.keys()
    assert "flagged" in found
    for name, values in expected.items():
        assert found[name].tobytes() == values.tobytes(), name


@pytest.mark.parametrize("name", METHODS)
def test_where_nothing_is_late_a_realtime_run_is_the_oracles_bit_for_bit(name: str) -> None:
    result, oracle = punctual(name, **METHODS[name])
    same(result, oracle)
    assert result.trace.flagged is not None
    assert not result.trace.flagged.any()
    assert not any("went on without" in warning for warning in result.warnings)
    heard = [node["on_time"] for node in result.metrics["timing"]["nodes"].values()]
    assert sum(heard) == result.metrics["messages"] > 0


def test_faults_on_purpose_come_on_top_and_are_not_counted_as_late() -> None:
    steps = 30
    result, oracle = punctual("ring", faults={"links": [EVERYTHING]}, **{"run.steps": steps})
    same(result, oracle)
    assert all(result.metrics["faults"][what] > 0 for what in ("lost", "corrupt", "late", "duplicate"))
    assert oracle.flagged is not None
    assert oracle.flagged.any()


def rows(out: Path, who: str) -> int:
    """Steps that a node has written down."""
    path = out / "rows" / f"{who}.f64"
    return path.stat().st_size if path.exists() else 0


class Stopped(Running):
    """The ring on the wall clock, node 3 stopped for at least ``steps`` steps of the others and so many seconds."""

    def stop_and_go(self, steps: int, seconds: float = 0.0) -> None:
        others = [f"node-{i}" for i in (1, 2, 4)]
        wait_for(lambda: min(rows(self.out, who) for who in ("node-3", *others)) > 0)
        wait_for(lambda: rows(self.out, "node-1") >= 8 * self.row)
        self.send("node-3", signal.SIGSTOP)
        at = {who: rows(self.out, who) for who in others}
        still = rows(self.out, "node-3")
        wait_for(lambda: all(rows(self.out, who) >= at[who] + steps * self.row for who in others))
        since = time.monotonic()
        wait_for(lambda: time.monotonic() > since + seconds)
        assert rows(self.out, "node-3") <= still + self.row  # the row that was being written
        self.send("node-3", signal.SIGCONT)

    row = 9 * 8  # bytes, at least


def test_the_others_go_on_without_a_node_that_is_stopped_and_it_catches_up() -> None:
    timing = "timing={mode: realtime, tick: 0.06, wait: 0.9}"
    with Stopped("ring.yaml", "--set", timing, steps=60) as stopped:
        stopped.stop_and_go(8)
        code = stopped.end()
    assert code in (0, 1), stopped.stderr
    assert "Traceback" not in stopped.stderr
    assert "realtime: 60 ticks of 0.06 s, about 3.6 s in all" in stopped.stderr
    metrics = stopped.metrics()
    trace = np.load(stopped.out / "trace.npz")
    assert metrics["steps"] == 60
    assert np.isfinite(trace["xhat"]).all()  # node 3 has made up for every step
    nodes = metrics["timing"]["nodes"]
    for i in "24":  # its neighbours
        assert nodes[i]["late"] + nodes[i]["missing"] >= 7
        flags = trace["flagged"][trace["node_ids"] == int(i)][0]
        assert flags.any()  # they come ...
        assert (flags[:-1] & ~flags[1:]).any()  # ... and go
    assert all(node["on_time"] + node["late"] + node["missing"] == 120 for node in nodes.values())
    said = {who: stopped.said(who)[-1]["timing"] for who in ("plant", "node-2")}
    assert said["node-2"] == nodes["2"]
    assert said["plant"] == metrics["timing"]["plant"]
    assert "its neighbours' messages" in " ".join(stopped.stdout.split())
    count = recorded(stopped.out / "recording.rrd", "/missing/node_2")
    assert max(count) >= 1
    assert count[0] == 0  # step 0 has all the time that it needs


def test_the_plant_waits_for_a_node_that_is_a_window_behind_and_says_so() -> None:
    timing = "timing={mode: realtime, tick: 0.02}"
    with Stopped("ring.yaml", "--set", timing, "--set", "run.window=8", steps=90) as stopped:
        wait_for(lambda: any(event["event"] == "ready" for event in stopped.said("recorder")))
        stopped.send("recorder", signal.SIGKILL)  # the recording is then made from the trace
        stopped.stop_and_go(3, seconds=0.6)  # that is 30 ticks, and 8 of them can pass
        assert stopped.end() in (0, 1), stopped.stderr
        plant = stopped.metrics()["timing"]["plant"]
    assert np.isfinite(np.load(stopped.out / "trace.npz")["xhat"]).all()
    assert plant["late_ticks"] >= 20
    assert plant["worst_lateness"] >= 0.6 - 9 * 0.02
    assert any(who.startswith("node-3 (at step") for who in plant["behind"])
    missing = recorded(stopped.out / "recording.rrd", "/missing/node_2")
    assert missing[0] == 0
    assert max(missing) >= 1
    assert "kept it waiting" in " ".join(stopped.stdout.split())


def recorded(path: Path, entity: str) -> list[float]:
    """A series of a recording, in the order of its steps."""
    from tests.report.synthetic import read_series

    return [float(value) for value in read_series(path, entity)[1]]


def test_in_one_process_there_is_no_clock() -> None:
    with Running("ring.yaml", "--set", "timing=realtime", "--in-process", "--no-record", steps=20) as oracle:
        assert oracle.end() in (0, 1)
    assert "realtime in one process is the ideal network" in " ".join(oracle.stderr.split())
    assert json.loads((oracle.out / "metrics.json").read_text())["steps"] == 20


def test_a_node_that_is_killed_ends_the_run_and_nothing_hangs() -> None:
    with Stopped("ring.yaml", "--set", "timing={mode: realtime, tick: 0.05}", "--no-record") as killed:
        wait_for(lambda: rows(killed.out, "node-3") >= 3 * killed.row)
        killed.send("node-3", signal.SIGKILL)
        assert killed.end() == 3
    assert "node-3 was killed by SIGKILL" in killed.stderr
