"""The command line: exit codes, what it prints, what it writes, and what it refuses without a trace."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from duio_mesh import cli
from tests.conftest import ROOT, TOPOLOGIES
from tests.scenario.broken import CASES, Case

PARTITIONED = str(TOPOLOGIES / "partitioned.yaml")


def test_in_process_writes_the_same_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([PARTITIONED, "--in-process", "--out", "run", "--plot"]) == 0
    out = capsys.readouterr().out
    assert "converged" in out
    assert "recording.rrd" in out
    names = {p.name for p in Path("run").iterdir()}
    assert {"scenario.yaml", "certificate.json", "trace.npz", "recording.rrd", "metrics.json"} <= names
    assert list(Path("run").glob("**/*.png"))
    with np.load("run/trace.npz", allow_pickle=False) as trace:
        assert trace["xhat"].shape == (4, 101, 9)
        assert trace["x"].shape == (101, 9)
        assert list(trace["node_ids"]) == [1, 2, 3, 4]
        assert trace["t"][1] == 60.0


def test_the_default_folder_is_by_name_and_time_with_latest() -> None:
    assert cli.main([PARTITIONED, "--in-process", "--no-record"]) == 0
    (run,) = [p for p in Path("runs/heat-partitioned").iterdir() if p.name != "latest"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ(-\d+)?", run.name)
    assert Path("runs/heat-partitioned/latest").resolve() == run.resolve()
    assert not (run / "recording.rrd").exists()


def test_a_run_that_does_not_converge_exits_1(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--in-process", "--no-record", "--set", "run.convergence.rms_below=1e-6"]
    assert cli.main([PARTITIONED, *options]) == 1
    assert "did not converge" in capsys.readouterr().out


def test_steps_and_seed_are_overrides() -> None:
    assert cli.main([PARTITIONED, "--in-process", "--no-record", "--steps=50", "--seed=7", "--out=a"]) in (0, 1)
    metrics = json.loads(Path("a/metrics.json").read_text())
    assert (metrics["steps"], metrics["seed"]) == (50, 7)


@pytest.mark.parametrize("option", ["--check", "--dry-run"])
def test_check_and_dry_run_start_and_write_nothing(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([PARTITIONED, option]) == 0
    out = capsys.readouterr().out
    assert ("spectral_radius" in out) if option == "--check" else ("duio-node-3" in out)
    assert list(Path().iterdir()) == []


def test_an_out_folder_with_something_in_it_is_refused_and_kept(capsys: pytest.CaptureFixture[str]) -> None:
    Path("precious").mkdir()
    Path("precious/data").write_text("keep")
    assert cli.main([PARTITIONED, "--out", "precious"]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert Path("precious/data").read_text() == "keep"


def test_an_infeasible_design_exits_2_in_plain_words(capsys: pytest.CaptureFixture[str]) -> None:
    star = "graph.edges=[[1,2],[1,3],[1,4],[1,5]]"
    assert cli.main([str(TOPOLOGIES / "six_state_ring.yaml"), "--set", star]) == 2
    err = capsys.readouterr().err
    assert "infeasible" in err
    assert "beta_u" in err
    assert "Traceback" not in err
    assert "SolverError" not in err
    assert list(Path().iterdir()) == []


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_broken_files_exit_2_and_leave_nothing(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("topology")
    folder.mkdir()
    path = case.write(folder)
    before = {p.relative_to(folder) for p in folder.rglob("*")}
    assert cli.main([str(path)]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines
    assert all(re.match(r".+\.yaml:\d+:\d+: ", line) for line in lines)
    assert {p.relative_to(folder) for p in folder.rglob("*")} == before
    assert list(Path().iterdir()) == [folder]


def test_a_broken_file_starts_no_process() -> None:
    """The real command, watched from outside: it forks nothing at all."""
    Path("broken.yaml").write_text("name: x\nplant: {time: discrete}\n")
    strace = "import sys, os\nos.fork = None\nimport subprocess\nsubprocess.Popen = None\n"
    code = f"{strace}sys.argv = ['launch.py', 'broken.yaml']\nfrom duio_mesh.cli import main\nsys.exit(main())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert re.match(r"broken.yaml:\d+:\d+: ", done.stderr)


def test_help_names_every_exit_code() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "--help"], capture_output=True, text=True, check=True
    )
    for word in ("--set", "--in-process", "130", "examples:"):
        assert word in done.stdout
