"""What a person reads: whole at 80 columns, as the user wrote it, and without a word about a reader that has gone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from duio_mesh import cli, console
from duio_mesh.console import Terminal
from tests.conftest import ROOT, TOPOLOGIES

RING = str(TOPOLOGIES / "ring.yaml")
QUICK = ["--in-process", "--no-record"]


@pytest.fixture(autouse=True)
def eighty_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    """The width of every log."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr(console, "_out", Terminal())


@pytest.mark.parametrize("options", [["--check"], [*QUICK, "--out", "run"]])
def test_a_reader_that_has_gone_does_not_change_the_exit_code(options: list[str]) -> None:
    """`launch.py ... | head -1`: the pipe is closed at once here, so that every line meets it broken."""
    command = [sys.executable, str(ROOT / "launch.py"), RING, *options]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    buffered = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}  # flushes at exit too
    with subprocess.Popen(command, **pipes, env=buffered, text=True) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        said = process.stderr.read()
    assert process.returncode == 0, said
    assert "Broken" not in said


def test_a_terminal_whose_errors_nobody_reads_goes_on() -> None:
    code = (
        "import os, sys\nfrom duio_mesh.console import Terminal\n"
        "read, write = os.pipe()\nos.dup2(write, 2)\nos.close(write)\nos.close(read)\n"
        "for _ in range(2):\n    Terminal(stderr=True).say('lost')\nprint('goes on')"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout == "goes on\n"


@pytest.mark.parametrize("name", ["a[b]c", "x[/y]z", "d:smile:", "long" * 30])
def test_a_path_is_printed_as_it_is_and_in_one_piece(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([RING, "--in-process", "--out", f"out/{name}"]) == 0
    lines = capsys.readouterr().out.splitlines()
    folder = Path("out", name).resolve()
    assert f"results    {folder}" in lines
    assert f"open with  rerun {folder / 'recording.rrd'}" in lines


def test_the_verdict_is_one_line_with_all_its_digits(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([RING, *QUICK, "--set", "run.convergence.over_last=0.001"]) in (0, 1)
    assert re.search(
        r"every node's RMS error over the last 0\.1% of the run .* below 0\.5$", said(capsys), re.MULTILINE
    )


def test_one_is_not_a_plural(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([RING, *QUICK, "--steps", "1"]) == 1
    assert "heat-ring: lmi, 4 nodes, 1 step\n" in capsys.readouterr().out
    assert console._count(1, "further loss", "further losses") == "1 further loss"
    assert console._count(2, "further loss", "further losses") == "2 further losses"
    assert console._count(0, "node") == "0 nodes"


def said(capsys: pytest.CaptureFixture[str]) -> str:
    out = capsys.readouterr().out
    assert "…" not in out, "something is cut"
    return out


def rows(out: str) -> dict[str, list[str]]:
    """First cell -> all cells of all tables in its rows."""
    found: dict[str, list[str]] = {}
    for line in out.splitlines():
        if line.startswith(("│", "┃")):
            first, *cells = (cell.strip() for cell in re.split("[│┃]", line)[1:-1])
            found.setdefault(first, []).extend(cells)
    return found


def test_few_nodes_have_a_column_each_in_as_many_tables_as_it_takes(capsys: pytest.CaptureFixture[str]) -> None:
    quantities = {"state_error_in_unknown_input": 194.906, "gain_norm": 6.16228, "reconstructs_alone": 2}
    console._by_node({i: {**quantities, "islands": {"not": "shown"}} for i in range(1, 9)})
    out = said(capsys)
    assert max(map(len, out.splitlines())) <= 80
    found = rows(out)
    assert found[""] == [f"node {i}" for i in range(1, 9)]
    assert found["state_error_in_unknown_input"] == ["194.906"] * 8
    assert "nodes (2 of 2)" in out


def test_many_nodes_have_a_row_each(capsys: pytest.CaptureFixture[str]) -> None:
    console._by_node({i: {f"quantity_{j}": i + j / 100 for j in range(14)} for i in range(1, 17)})
    out = said(capsys)
    assert max(map(len, out.splitlines())) <= 80
    found = rows(out)
    assert found["node"] == [f"quantity_{j}" for j in range(14)]
    assert found["16"] == [f"{16 + j / 100:g}" for j in range(14)]


def test_a_long_list_is_below_the_table_and_whole(capsys: pytest.CaptureFixture[str]) -> None:
    modes = [f"-0.{i:05} +- {i}.5j" for i in range(1, 20)]
    console._by_node({1: {"modes": modes, "left": 38}, 2: {"modes": [], "left": 0}})
    out = said(capsys)
    table, below = out.split("modes:\n")
    assert "│ left │ 38     │ 0      │" in table
    assert f"node 1 [{', '.join(modes)}] node 2 []" == " ".join(below.split())
    console._by_node({1: {"modes": modes}})
    assert f"modes: node 1 [{', '.join(modes)}]" == " ".join(said(capsys).split()), "a table of nothing is left out"


@pytest.mark.parametrize("file", ["admm_ring", "reduced_order_newengland18", "six_state_ring"])
def test_no_name_of_a_certificate_is_cut(file: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(TOPOLOGIES / f"{file}.yaml")
    assert cli.main([str(path), "--check"]) == 0
    assert max(map(len, said(capsys).splitlines())) <= 80


def test_a_dry_run_names_the_processes_and_no_command_that_cannot_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([RING, "--dry-run"]) == 0
    out = capsys.readouterr().out
    for name, module in (("plant", "plant"), ("node-3", "node"), ("recorder", "recorder")):
        assert re.search(rf"^duio-{name} +duio_mesh\.{module} +\w", out, re.MULTILINE)
    assert "--spec" not in out
    assert out.count("launch.py export") == 1
