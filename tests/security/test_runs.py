"""Whole runs with security: the same bits as the oracle, and nothing secret left behind."""

from __future__ import annotations

import dataclasses
import signal
import stat
from pathlib import Path

import psutil
import pytest

import duio_mesh
from duio_mesh import launcher
from duio_mesh.errors import ScenarioError
from duio_mesh.scenario.model import Security
from tests.conftest import started_in, wait_for
from tests.processes.running import Running
from tests.security.rogue import design_of

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

STEPS = 60


@pytest.mark.parametrize("mode", ["mtls", "password"])
@pytest.mark.parametrize("topology", ["ring", "augmented_directed", "partitioned"])
def test_a_guarded_run_equals_the_oracle_bit_for_bit(topology: str, mode: str) -> None:
    design = design_of(mode, topology, STEPS)
    expected = duio_mesh.simulate(design).arrays()
    result = duio_mesh.run(design, "run", record=False)
    found = result.trace.arrays()
    assert found.keys() == expected.keys()
    for array, values in expected.items():
        assert found[array].tobytes() == values.tobytes(), array
    assert result.metrics["rejected"] == {}
    assert result.warnings == ()
    assert not (result.folder / "keys").exists()
    assert secrets_in(result.folder) == []


def secrets_in(folder: Path) -> list[Path]:
    return [p for p in folder.rglob("*") if p.is_file() and b"PRIVATE KEY" in p.read_bytes()]


@pytest.mark.parametrize("mode", ["mtls", "password"])
def test_the_recorder_is_let_in_and_credentials_stay_where_that_is_wanted(mode: str) -> None:
    design = design_of(mode, "ring", STEPS)
    kept = dataclasses.replace(design.scenario, security=Security(mode, keep=True))  # type: ignore[arg-type]
    result = duio_mesh.run(dataclasses.replace(design, scenario=kept), "run")
    assert result.warnings == ()  # nobody waited for the recorder in vain
    assert (result.folder / "recording.rrd").exists()
    keys = result.folder / "keys"
    assert {p.name for p in keys.iterdir()} == {"plant", "recorder", *(f"node-{i}" for i in design.nodes)}
    for path in keys.rglob("*"):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)
    assert all(keys in p.parents for p in secrets_in(result.folder))
    assert bool(secrets_in(result.folder)) == (mode == "mtls")


def test_an_address_that_is_refused_leaves_nothing() -> None:
    with pytest.raises(ScenarioError, match=r"listening on 0\.0\.0\.0"):
        launcher.run(design_of("open", steps=STEPS), "run", address="0.0.0.0")
    assert not Path("run").exists()


def test_certificates_are_for_the_address_that_the_run_listens_on() -> None:
    design = design_of("mtls", steps=STEPS)
    result = launcher.run(design, "run", record=False, address="127.0.0.2")
    assert result.trace.xhat.tobytes() == duio_mesh.simulate(design).xhat.tobytes()


def test_a_failed_run_leaves_no_credentials_either(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    seen = []

    def look(progress: launcher.Progress) -> None:
        seen.append((Path("run") / "keys").exists())
        fail()

    with pytest.raises(KeyboardInterrupt):
        launcher.run(design_of("mtls", steps=100_000), "run", record=False, show=look)
    assert seen == [True]
    assert not (Path("run") / "keys").exists()


PROCESSES = ("plant", *(f"node-{i}" for i in (1, 2, 3, 4)))


def gone(pid: int) -> bool:
    return not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE


@pytest.mark.parametrize("mode", ["mtls", "password"])
def test_a_killed_launcher_leaves_no_credentials(mode: str) -> None:
    """Not even when a process does not feel that it shall end; and nobody loses its own before it has ended."""
    with Running("ring.yaml", "--no-record", "--set", f"security={mode}") as run:
        run.until_row("node-1", 100)
        keys = run.out / "keys"
        assert {path.name for path in keys.iterdir()} == set(PROCESSES)
        pids = [run.pid(who) for who in PROCESSES]
        run.send("node-3", signal.SIGSTOP)
        run.send("launcher", signal.SIGKILL)
        wait_for(lambda: not (keys / "node-1").exists())
        assert all(gone(pid) for pid in pids)
        assert run.end() == -signal.SIGKILL  # the nursery, which holds our pipes, has ended too
    assert not keys.exists()
    assert secrets_in(run.out) == []


def test_a_killed_launcher_leaves_credentials_where_that_is_wanted() -> None:
    with Running("ring.yaml", "--no-record", "--set", "security={mode: mtls, keep: true}") as run:
        run.until_row("node-1", 100)
        run.send("launcher", signal.SIGKILL)
        run.end()
        wait_for(lambda: not started_in(run.out.parent))
    assert len(secrets_in(run.out / "keys")) == len(PROCESSES)
