"""A node is lost that nobody had planned to lose: `kill -9` and frozen for good, under each policy."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import psutil
import pytest

import duio_mesh
from duio_mesh.report.trace_file import read_trace
from duio_mesh.trace import Trace
from tests.conftest import wait_for
from tests.processes.running import Running
from tests.processes.test_recovery import design_of

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

STEPS, HALT = 3000, 400
SOON = 2.0  # seconds in which neighbours notice a death; milliseconds on a quiet machine
LONG_WAIT = "run.deadline=60.0"
SHORT_WAIT = "run.deadline=1.0"


def asked(policy: str, *more: str) -> list[str]:
    """Options of the command line."""
    settings = [f"run.on_node_loss={policy}", *more]
    return ["--no-record", *(word for text in settings for word in ("--set", text))]


def happened(run: Running, who: str, event: str) -> list[dict[str, Any]]:
    return [e for e in run.said(who) if e["event"] == event]


def about(run: Running, who: str, event: str, node: int) -> list[dict[str, Any]]:
    return [e for e in happened(run, who, event) if e["node"] == node]


@contextmanager
def halted(*options: str, at: int = HALT) -> Iterator[Running]:
    """A run whose node 1 has stopped at the beginning of a step; nobody has anything left to do when node 3 says so.

    Node 3 is then in step HALT or HALT + 1 and waits for 2 and 4, to which everything that it sent has gone.
    """
    with Running(
        "ring.yaml", *options, "--set", f'faults.nodes=[{{"node": 1, "pause": {at}, "seconds": 50}}]', steps=STEPS
    ) as run:
        wait_for(lambda: happened(run, "node-1", "pausing"))
        wait_for(lambda: happened(run, "node-3", "waiting"))
        yield run


def oracle(*faults: dict[str, Any], policy: str) -> Trace:
    return duio_mesh.simulate(
        design_of("ring", {"nodes": list(faults)}, **{"run.on_node_loss": policy, "run.steps": STEPS})
    )


def equal(run: Running, expected: Trace, since: int) -> None:
    """All bits of the survivors, and those of node 3 from this step on."""
    found = read_trace(run.out / "trace.npz")
    assert found.flagged is not None
    assert expected.flagged is not None
    assert found.node_ids.tolist() == [1, 2, 3, 4]
    for row in (0, 1, 3):
        assert found.xhat[row].tobytes() == expected.xhat[row].tobytes()
        assert found.flagged[row].tobytes() == expected.flagged[row].tobytes()
    assert found.xhat[2, since:].tobytes() == expected.xhat[2, since:].tobytes()
    assert found.flagged[2, since:].tobytes() == expected.flagged[2, since:].tobytes()


def lost_at(run: Running) -> int:
    """The step at which both neighbours lost node 3."""
    found = {e["who"]: (e["node"], e["k"]) for e in events(run, "lost")}
    assert found.keys() == {"node-2", "node-4"}
    ((node, k),) = set(found.values())
    assert node == 3
    assert HALT < k <= HALT + 2
    return int(k)


def journal(run: Running, who: str) -> int:
    return (run.out / "rows" / f"{who}.f64").stat().st_size


def events(run: Running, what: str) -> list[dict[str, Any]]:
    return [e for e in run.metrics()["events"] if e["event"] == what]


def test_stop() -> None:
    with halted(*asked("stop", LONG_WAIT)) as run:
        run.send("node-3", signal.SIGKILL)
        assert run.end() == 3
        assert "run failed: node-3 was killed by SIGKILL; " in run.stderr
        assert run.metrics()["verdict"] == "incomplete"
        assert "node-3 was killed by SIGKILL" in run.metrics()["failure"]


def test_degrade_gives_the_bits_of_a_planned_kill() -> None:
    with halted(*asked("degrade", LONG_WAIT)) as run:
        run.send("node-3", signal.SIGKILL)
        wait_for(lambda: not run.exists("node-3"))
        run.send("node-1", signal.SIGCONT)
        assert run.end() == 0, run.stderr
        assert "warning: node-3: node-3 was killed by SIGKILL; the others went on without it" in run.stdout
        assert "converged, but node 3 is gone from step" in run.stdout
        assert [e["text"] for e in events(run, "death")] == ["node-3 was killed by SIGKILL"]
        assert run.metrics()["verdict"] == "converged"
        equal(run, oracle({"node": 3, "kill": lost_at(run)}, policy="degrade"), STEPS)


def test_restart_gives_the_bits_of_a_planned_restart() -> None:
    """Node 1 goes on when the new process has asked to come back; at which step that is, is read off."""
    with halted(*asked("restart", LONG_WAIT)) as run:
        first = run.pid("node-3")
        run.send("node-3", signal.SIGKILL)
        wait_for(lambda: len(happened(run, "node-3", "ready")) == 2)
        assert run.pid("node-3") != first
        run.send("node-1", signal.SIGCONT)
        assert run.end() == 0, run.stderr
        assert "warning: node-3: node-3 was killed by SIGKILL; another process took its place" in run.stdout
        ((who, k, told_by),) = [(e["who"], e["k"], e["told_by"]) for e in events(run, "back")]
        assert (who, told_by) == ("node-3", 2)
        joined = {(e["who"], e["node"], e["k"]) for e in events(run, "joined")}
        assert joined == {("node-2", 3, k), ("node-4", 3, k)}
        assert f"to {k - 1}; steps from the return until" in " ".join(run.stdout.split())
        lost = lost_at(run)
        equal(run, oracle({"node": 3, "restart": lost, "away": k - lost}, policy="restart"), k)


@pytest.mark.parametrize(("policy", "code"), [("degrade", 3), ("restart", 0)])
def test_a_node_that_dies_at_the_start(policy: str, code: int) -> None:
    """A run begins with everybody: with another process, or not at all, which is said at once."""
    with Running("ring.yaml", *asked(policy, LONG_WAIT), steps=STEPS) as run:
        wait_for(lambda: run.exists("node-2"))
        run.send("node-2", signal.SIGKILL)
        assert run.end() == code, run.stderr
        if code:
            assert "run failed: node-2 was killed by SIGKILL" in run.stderr
        else:
            assert [e["who"] for e in events(run, "back")] == ["node-2"]


def test_neighbours_notice_within_milliseconds_and_one_node_after_the_other_comes_back() -> None:
    """In full run: everybody is killed once, and each time only its neighbours say so, at once."""
    with Running("ring.yaml", *asked("restart", "run.deadline=30.0")) as run:
        run.until_row("node-3", 200)
        for victim, neighbours in ((3, (2, 4)), (1, (2, 4)), (2, (1, 3))):
            killed = time.time()
            run.send(f"node-{victim}", signal.SIGKILL)
            for j in neighbours:
                wait_for(partial(about, run, f"node-{j}", "joined", victim))
                (lost,) = about(run, f"node-{j}", "lost", victim)
                print(f"node-{j} noticed the death of node-{victim} after {1e3 * (lost['time'] - killed):.1f} ms")
                assert 0 <= lost["time"] - killed < SOON
            wait_for(partial(happened, run, f"node-{victim}", "back"))
        run.send("launcher", signal.SIGINT)
        assert run.end() == 130
        deaths = {e["who"]: e["seconds"] for e in events(run, "death")}
        assert list(deaths) == ["node-3", "node-1", "node-2"]
        for e in events(run, "lost"):
            apart = e["seconds"] - deaths[f"node-{e['node']}"]
            print(f"{e['who']} said so {1e3 * apart:+.0f} ms after the nursery")
            assert abs(apart) < SOON


@pytest.mark.parametrize(("policy", "then"), [("degrade", "lost"), ("restart", "joined")])
def test_a_frozen_node_is_killed_for_certain(policy: str, then: str) -> None:
    """SIGSTOP for good: after the deadline it is lost like any other."""
    with Running("ring.yaml", *asked(policy, SHORT_WAIT)) as run:
        run.until_row("node-3", 200)
        frozen = psutil.Process(run.pid("node-3"))
        run.send("node-3", signal.SIGSTOP)
        for j in (2, 4):
            wait_for(partial(happened, run, f"node-{j}", then))
        assert not frozen.is_running()
        rows = journal(run, "node-2")
        wait_for(lambda: journal(run, "node-2") > rows)  # the others go on
        run.send("launcher", signal.SIGINT)
        assert run.end() == 130
        assert [e["text"] for e in events(run, "death")] == ["node-3 was killed by SIGKILL"]
        assert any(e["on"] == ["node-3"] and e["link"].startswith("edge 3 -> ") for e in events(run, "waiting"))


def test_a_pause_that_is_longer_than_the_deadline_is_a_loss() -> None:
    with Running(
        "ring.yaml",
        *asked("degrade", SHORT_WAIT, 'faults.nodes=[{"node": 3, "pause": 400, "seconds": 50}]'),
        steps=STEPS,
    ) as run:
        assert run.end() == 0, run.stderr
        words = " ".join(run.stdout.split())
        assert "warning: node-3: kept " in words
        assert "waiting for 1 s; killed" in words
        assert "node-3 was killed by SIGKILL; the others went on without it" in words


def test_a_node_whose_processes_all_die_ends_the_run() -> None:
    """They cannot write their log, because a folder is in its place."""
    with halted(*asked("restart", LONG_WAIT)) as run:
        log = run.out / "logs" / "node-3.jsonl"
        log.unlink()
        log.mkdir()
        run.send("node-3", signal.SIGKILL)
        assert run.end() == 3
        assert "node-3 did not come back: 3 processes in a row were lost before they were in step" in run.stderr
        assert [e["text"] for e in events(run, "death")] == [
            "node-3 was killed by SIGKILL",
            *["node-3 ended with exit code 70"] * 3,
        ]


def test_the_last_node_of_all() -> None:
    """Degrade has nobody left to go on with."""
    with halted(*asked("degrade", LONG_WAIT)) as run:
        for i in (1, 2, 3, 4):
            run.send(f"node-{i}", signal.SIGKILL)
        assert run.end() == 3
        assert "the plant has lost every node" in run.stderr


def test_a_run_that_takes_too_long() -> None:
    """It says who waits for whom, and for what."""
    with halted(*asked("stop", LONG_WAIT, "run.max_seconds=5"), at=0) as run:
        assert run.end() == 3
        assert "the run took longer than run.max_seconds = 5 s (" in run.stderr
        assert "node-2 waits for node-1 (edge 1 -> 2, step 0, round 0)" in run.stderr
        assert "node-1 is stopped" in run.stderr
        assert "max_seconds" in run.metrics()["failure"]


@pytest.mark.parametrize("policy", ["degrade", "restart"])
def test_a_lost_node_whose_frames_were_to_come_late(policy: str) -> None:
    """What it had not sent yet is waited for neither from it nor from the process that takes its place."""
    late = "faults={links: [{delay: {steps: 200}}]}"
    with Running("ring.yaml", *asked(policy, late, "run.deadline=3.0"), steps=12_000) as run:
        run.until_row("node-2", 1000)
        run.send("node-2", signal.SIGKILL)
        assert run.end() in (0, 1), run.stderr
        assert len(read_trace(run.out / "trace.npz").t) == 12_000


def test_a_pause_within_the_deadline_is_survived_however_long_the_deadline_is() -> None:
    """Zenoh's own patience with a peer that says nothing is ten seconds, unless somebody may wait longer."""
    pause = "faults={nodes: [{node: 2, pause: 100, seconds: 11}]}"
    with Running("ring.yaml", "--no-record", "--set", "run.deadline=30", "--set", pause, steps=200) as run:
        assert run.end() == 0, run.stderr
    expected = duio_mesh.simulate(design_of("ring", {"nodes": []}, **{"run.steps": 200}))
    assert read_trace(run.out / "trace.npz").xhat.tobytes() == expected.xhat.tobytes()
