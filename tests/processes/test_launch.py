"""What a user's circumstances must not change, and what a failed run still says."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

import duio_mesh
from duio_mesh import cli, launcher
from duio_mesh.diagnosis import Process
from duio_mesh.recovery import Recovery
from duio_mesh.supervisor import Supervisor
from tests.conftest import TOPOLOGIES
from tests.processes.running import Running

pytestmark = pytest.mark.mesh


@pytest.mark.usefixtures("nothing_left")
@pytest.mark.parametrize("name", ["numpy.py", "signal.py", "duio_mesh.py"])
def test_files_of_the_present_folder_are_not_imported(name: str) -> None:
    Path(name).write_text("raise SystemExit('imported')\n")
    with Running("ring.yaml", "--no-record", steps=20) as run:
        assert run.end() in (0, 1), run.stderr
        assert run.metrics()["steps"] == 20


@pytest.mark.usefixtures("nothing_left")
def test_a_node_that_somebody_else_asked_to_stop_is_the_cause() -> None:
    with Running("ring.yaml", "--no-record") as run:
        run.until_row("node-2", 10)
        run.send("node-2", signal.SIGTERM)
        assert run.end() == 3
        assert "run failed: node-2 was asked to stop, by somebody else's SIGTERM; " in run.stderr


@pytest.mark.parametrize("ready", [True, False])
def test_a_node_that_is_lost_before_everybody_was_there(ready: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run goes on without it only if the others do not look for it any more."""
    monkeypatch.setattr("duio_mesh.recovery.READY", 0.0)
    with Supervisor() as supervisor:
        processes = supervisor.processes
        processes |= {who: Process(who) for who in ("plant", "node-1", "node-2", "recorder")}
        for who in ("plant", "node-1", "node-2")[: 3 if ready else 2]:
            processes[who].hear({"event": "ready"}, 0.0)
        lost = processes["node-1"]
        lost.hear({"event": "exit", "code": -9}, 0.0)
        assert Recovery(supervisor, "degrade", lambda who, before: None)(lost) is ready
        assert lost.there is not ready
        text = "the others went on without it" if ready else "a run begins with everybody"
        assert lost.warnings[0].endswith(text)


@pytest.mark.usefixtures("nothing_left")
def test_an_overflow_of_the_plant_is_the_plants() -> None:
    settings = ["--set", "plant.control=", "--set", "plant.disturbance=[{normal: {std: 1e300}}]"]
    with Running("augmented_example9.yaml", "--no-record", *settings, steps=50_000) as run:
        assert run.end() == 3
        assert "overflowed at step" in run.stderr
        assert "Warning" not in run.stderr


@pytest.mark.parametrize("other", ["--no-record", "--in-process", "--check", "--dry-run"])
def test_live_without_a_recorder_is_refused(other: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as e:
        cli.main([str(TOPOLOGIES / "ring.yaml"), "--live", other])
    assert e.value.code == 2
    assert "--live shows what the recorder process" in capsys.readouterr().err


def test_out_that_cannot_be_written_is_refused_before_the_design(capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").write_text("")
    assert cli.main([str(TOPOLOGIES / "ring.yaml"), "--out", "file"]) == 2
    assert "--out file: is not a folder" in capsys.readouterr().err
    assert cli.main([str(TOPOLOGIES / "ring.yaml"), "--out", "file/below"]) == 2
    assert "nothing can be written in" in capsys.readouterr().err


def test_a_second_interrupt_does_not_cost_the_results() -> None:
    with launcher._undisturbed():
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("admm_ring", {"run.steps": 5}),
        ("finite_time_ring", {"run.steps": 30, "run.batch": 7, "observer.setup": "distributed"}),
        ("ring", {"run.steps": 30, "faults": {"links": [{"loss": 0.1}]}}),
    ],
)
def test_the_oracle_counts_as_processes_do(name: str, changes: dict[str, object]) -> None:
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes))
    mesh = launcher.run(design, "mesh", record=False).metrics
    oracle = launcher.run_in_process(design, "oracle", record=False).metrics
    assert mesh.keys() == oracle.keys()
    for counted in ("rounds", "messages", "faults", "rejected", "events", "failure", "estimates_sha256"):
        assert mesh.get(counted) == oracle.get(counted), counted


@pytest.mark.parametrize("event", ["failed", "stopped", "done"])
def test_what_a_process_refused_is_known_however_it_ends(event: str) -> None:
    process = Process("node-1")
    process.hear({"event": event, "text": "", "rejected": {"checksum": 2}}, 0.0)
    assert process.rejected == {"checksum": 2}
