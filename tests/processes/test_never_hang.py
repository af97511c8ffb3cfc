"""Everybody is killed and stopped once at the start, in the middle and at the end: the run ends as it should.

Nothing is left: no process (so no socket either) and no credentials. Who is stopped makes the others wait for the run's
deadline, which is short here; there is no other time in these tests that anything depends on.
"""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress

import numpy as np
import psutil
import pytest

from tests.conftest import wait_for
from tests.processes.running import LONG, Running

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

BOUND = 60.0  # seconds for any end at all, on a machine however busy
STEPS = 600  # of a run that is to be finished
KILL, STOP = signal.SIGKILL, signal.SIGSTOP
BOTH = pytest.mark.parametrize("number", [KILL, STOP])
ALL = pytest.mark.parametrize("who", ["node-2", "plant", "recorder", "launcher"])
NODES = [f"node-{i}" for i in (1, 2, 3, 4)]


def run_with(who: str, steps: int, *settings: str) -> Running:
    """A run with credentials, and with a recorder where that is the victim."""
    options = [word for text in ("security=password", *settings) for word in ("--set", text)]
    return Running("ring.yaml", *options, *([] if who == "recorder" else ["--no-record"]), steps=steps)


def fatal(who: str, number: signal.Signals) -> bool:
    """Whether the run cannot go on without it."""
    return who in ("node-2", "plant") or (who, number) == ("launcher", KILL)


def happened(run: Running, who: str, event: str) -> bool:
    return any(e["event"] == event for e in run.said(who))


def assert_end(run: Running, who: str, number: signal.Signals) -> None:
    """How such a run has to end."""
    code = run.end(BOUND)
    assert "Traceback" not in run.stderr
    if who == "launcher":
        assert code == (-KILL if number == KILL else 0), run.stderr
    elif who == "recorder":
        assert code == 0, run.stderr
        assert "the recording was made from the trace instead" in " ".join(run.stdout.split())
        readable(run)
    else:
        assert code == 3
        words = f"{who} was killed by SIGKILL" if number == KILL else f"{who} is stopped"
        assert words in run.stderr
        found = run.metrics()
        assert words in found["failure"]
        assert found["verdict"] == "incomplete" or found["steps"] == STEPS  # the plant is lost after all is said
    wait_for(lambda: not (run.out / "keys").exists())


def readable(run: Running) -> None:
    """What there is of the run can be read: a trace, metrics, and a recording that has the errors."""
    from rerun.chunk import RrdReader

    with np.load(run.out / "trace.npz", allow_pickle=False) as trace:
        assert trace["xhat"].shape[0] == 4
        assert len(trace["t"]) == trace["x"].shape[0] == trace["xhat"].shape[1] > 0
    assert run.metrics()["steps"] > 0
    chunks = list(RrdReader(run.out / "recording.rrd").stream())
    assert chunks


@BOTH
@ALL
def test_at_the_start(who: str, number: signal.Signals) -> None:
    """As soon as it exists."""
    with run_with(who, LONG if fatal(who, number) else STEPS, "run.deadline=1.0") as run:
        wait_for((run.out / "nodes").exists if who == "launcher" else lambda: run.exists(who))
        run.send(who, number)
        if (who, number) == ("launcher", STOP):
            threading.Event().wait(1.0)  # it is continued after a while
            run.send(who, signal.SIGCONT)
        assert_end(run, who, number)


@BOTH
@ALL
def test_in_the_middle(who: str, number: signal.Signals) -> None:
    if not fatal(who, number):
        strike_at(STEPS // 2, who, number)
        return
    with run_with(who, LONG, "run.deadline=1.0") as run:
        run.until_row("node-3", 200)
        run.send(who, number)
        assert_end(run, who, number)


@BOTH
@ALL
def test_at_the_end(who: str, number: signal.Signals) -> None:
    """Before the very last step is done; the recorder has nothing left but to close its file."""
    strike_at(STEPS - 1, who, number)


def strike_at(step: int, who: str, number: signal.Signals) -> None:
    """Where node 1 has stopped at the beginning of a step, so that everybody waits for it; then it goes on."""
    pause = f'faults.nodes=[{{"node": 1, "pause": {step}, "seconds": 50}}]'
    with run_with(who, STEPS, "run.deadline=3.0", pause) as run:
        wait_for(lambda: happened(run, "node-1", "pausing"))
        node = run.pid("node-1")
        wait_for(lambda: psutil.Process(node).status() == psutil.STATUS_STOPPED)  # it says so before it does
        run.send(who, number)
        with suppress(ProcessLookupError):  # nothing is left of a run without a launcher
            os.kill(node, signal.SIGCONT)
        if (who, number) == ("launcher", STOP):  # the others do not need it to finish
            wait_for(lambda: all(happened(run, other, "done") for other in (*NODES, "plant")))
            run.send(who, signal.SIGCONT)
        assert_end(run, who, number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_keeps_what_it_has(number: signal.Signals) -> None:
    with run_with("recorder", LONG) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 200)
        run.send("launcher", number)
        assert run.end(BOUND) == 130
        assert "interrupted" in run.stderr
        assert "Traceback" not in run.stderr
        readable(run)
        assert not (run.out / "keys").exists()


def test_the_nursery_takes_everybody_along_when_it_is_killed() -> None:
    with run_with("nobody", LONG) as run:
        run.until_row("node-1", 200)
        run.send("nursery", KILL)
        assert run.end(BOUND) == 3
        assert "nursery" in run.stderr
        assert "Traceback" not in run.stderr
        assert not (run.out / "keys").exists()


def test_the_recorder_closes_its_file_when_the_launcher_is_killed() -> None:
    with run_with("recorder", LONG) as run:
        run.until_ready("recorder")
        run.until_row("node-1", 200)
        run.send("launcher", KILL)
        assert run.end(BOUND) == -KILL
        wait_for(lambda: happened(run, "recorder", "done"))
