"""Every process is killed, stopped or interrupted once: the run ends as it should, and nothing is left."""

from __future__ import annotations

import signal
import time

import numpy as np
import pytest

from tests.conftest import wait_for
from tests.processes.running import Running

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

TOPOLOGY = "ring.yaml"
ENDING = 5.0  # seconds that an end may take
SLACK = 5.0  # for a loaded machine


def readable(run: Running) -> None:
    """What there is of the run can be read: a trace, metrics, and a recording that has the errors."""
    from rerun.chunk import RrdReader

    with np.load(run.out / "trace.npz", allow_pickle=False) as trace:
        assert trace["xhat"].shape[0] == 4
        assert len(trace["t"]) == trace["x"].shape[0] == trace["xhat"].shape[1] > 0
    assert run.metrics()["steps"] > 0
    chunks = list(RrdReader(run.out / "recording.rrd").stream())
    assert chunks


@pytest.mark.parametrize("who", ["node-3", "plant"])
def test_a_killed_process_ends_the_run_at_once(who: str) -> None:
    with Running(TOPOLOGY) as run:
        run.until_ready("recorder")
        run.until_row("node-3", 200)
        run.send(who, signal.SIGKILL)
        begin = time.monotonic()
        assert run.end() == 3
        assert time.monotonic() - begin < ENDING + SLACK
        assert f"{who} was killed by SIGKILL" in run.stderr
        assert "Traceback" not in run.stderr
        readable(run)
        assert who in run.metrics()["failure"]


def test_a_stopped_node_is_named_by_those_who_wait_for_it() -> None:
    with Running(TOPOLOGY, "--set", "run.deadline=1.0") as run:
        run.until_ready("recorder")
        run.until_row("node-3", 200)
        run.send("node-3", signal.SIGSTOP)
        begin = time.monotonic()
        assert run.end() == 3
        assert time.monotonic() - begin < 1.0 + ENDING + SLACK
        assert "waited 1 s on edge 3 -> " in run.stderr
        assert "for step" in run.stderr
        assert "it last sent step" in run.stderr
        readable(run)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGHUP, 130)])
def test_an_interrupted_run_keeps_what_it_has(number: signal.Signals, code: int) -> None:
    with Running(TOPOLOGY) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 200)
        run.send("launcher", number)
        begin = time.monotonic()
        assert run.end() == code
        assert time.monotonic() - begin < ENDING + SLACK
        assert "interrupted" in run.stderr
        assert "Traceback" not in run.stderr
        readable(run)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_run_does_not_need_its_recorder(number: signal.Signals) -> None:
    """Killed or frozen in the middle, it costs neither the run nor the trace; the recording is made good."""
    steps = 5_000
    with Running(TOPOLOGY, steps=steps) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 100)
        run.send("recorder", number)
        assert run.end() == 0, run.stderr
        assert run.metrics()["steps"] == steps
        assert "the recording was made from the trace" in run.stdout
        readable(run)


def test_the_children_of_a_killed_launcher_end_by_themselves() -> None:
    with Running(TOPOLOGY) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 200)
        pids = [run.pid(who) for who in ("plant", "node-1", "node-2", "node-3", "node-4", "recorder")]
        run.send("launcher", signal.SIGKILL)
        assert run.end() == -signal.SIGKILL
        wait_for(lambda: not any(alive(pid) for pid in pids), ENDING + SLACK)
        assert any(e["event"] == "done" for e in run.said("recorder"))  # it closed its file


def test_the_nursery_takes_everybody_along_when_it_is_killed() -> None:
    with Running(TOPOLOGY) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 200)
        run.send("nursery", signal.SIGKILL)
        assert run.end() == 3
        assert "nursery" in run.stderr
        assert "Traceback" not in run.stderr


@pytest.mark.parametrize("who", ["node-2", "plant"])
def test_a_process_that_never_starts_properly_ends_the_run(who: str) -> None:
    """Stopped as soon as it exists: the others name the link that nobody answers, or the launcher the process."""
    with Running(TOPOLOGY) as run:
        wait_for(lambda: (run.out / "nodes" / f"{who}.spec").exists())
        wait_for(lambda: exists(run, who))
        run.send(who, signal.SIGKILL)
        assert run.end() == 3
        assert f"{who} was killed by SIGKILL" in run.stderr


def exists(run: Running, who: str) -> bool:
    try:
        return bool(run.pid(who))
    except AssertionError:
        return False


def alive(pid: int) -> bool:
    import psutil

    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
