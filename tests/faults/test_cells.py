"""The table of docs/reliability.md: its cases have room for the faults, and it tells right, flagged and wrong apart."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from duio_mesh import load_scenario
from duio_mesh.simulation import Trace
from tests.conftest import ROOT, TOPOLOGIES

LIMIT, A, B, K = 0.1, 40, 60, 120


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """bench/fault_cells.py."""
    monkeypatch.syspath_prepend(ROOT / "bench")
    return importlib.import_module("fault_cells")


def trace(error: Any, flagged: Any) -> Trace:
    """Two nodes, two states that are 1; the errors (K,) are node 2's."""
    x = np.ones((K, 2))
    xhat = np.stack([x, x + error[:, None]])
    return Trace(np.arange(K) * 1.0, x, np.array([1, 2]), xhat, flagged=np.stack([np.zeros(K, dtype=bool), flagged]))


def judged(bench: ModuleType, error: Any, flagged: Any) -> Any:
    """The cell of such a run under a fault in steps A to B - 1, against a fault-free one with an error of 0.01."""
    fault = bench.Fault("losses", {}, (A, B))
    return bench.judged("case", "fault", fault, trace(error, flagged), np.full((2, K), 0.01), LIMIT)


def test_right_flagged_and_wrong(bench: ModuleType) -> None:
    error, flagged = np.full(K, 0.01), np.zeros(K, dtype=bool)
    fine = judged(bench, error, flagged)
    assert (fine.verdict, fine.steps, fine.doubted, fine.flagged) == ("right", 0, 0, 0)
    error[A : B + 10] = 1.0
    assert judged(bench, error, flagged).verdict == "**WRONG**"
    flagged[A : B + 15] = True
    marked = judged(bench, error, flagged)
    assert (marked.verdict, marked.steps, marked.doubted) == ("flagged", 10, 15)
    assert marked.during == pytest.approx(1)
    assert marked.trusted == pytest.approx(0.01)
    flagged[B : B + 4] = False  # four bad ones among good ones: 1 in 20 of the mean square each
    assert judged(bench, error, flagged).verdict == "**WRONG**"
    error[A:] = np.inf
    gone = judged(bench, error, np.arange(K) >= A)
    assert (gone.verdict, gone.steps, gone.doubted) == ("flagged", None, None)


def test_every_case_has_room_and_its_faults_are_accepted(bench: ModuleType) -> None:
    for case in bench.CASES:
        a, b = case.during
        assert bench.WINDOW <= a < b <= case.steps - bench.WINDOW
        path, changes = TOPOLOGIES / f"{case.topology}.yaml", {"run.steps": case.steps} | case.changes
        found = dict(bench.faults_of(case, load_scenario(path, **changes).graph))
        assert len(found) == 16
        for name in ("partition, healed", "kill, restart"):
            steps = {"run.steps": case.steps + found[name].steps}
            faults = load_scenario(path, **changes | steps | found[name].changes).faults
            assert faults.links or faults.nodes


@pytest.mark.mesh
@pytest.mark.usefixtures("nothing_left")
def test_cells_as_processes(bench: ModuleType) -> None:
    case = bench.Case("lmi, star", "star", 160, (100, 120))
    names = ("loss 20 %", "kill, restart", "pause, resume")
    found = {cell.fault: cell for cell in bench.cells((case,), True, names)}
    assert tuple(found) == names
    assert all(cell.same is True for cell in found.values())
    assert {cell.verdict for cell in found.values()} <= {"right", "flagged"}
    assert found["pause, resume"].final == found["pause, resume"].clean


def test_the_script_fails_where_a_cell_is_silently_wrong(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    script = importlib.import_module("reliability")
    monkeypatch.setattr(sys, "argv", ["reliability.py"])
    cell = judged(bench, np.full(K, 0.01), np.zeros(K, dtype=bool))
    for shown, code in ((cell, 0), (cell._replace(verdict="**WRONG**"), 1), (cell._replace(same=False), 1)):
        monkeypatch.setattr(script, "cells", lambda *_, shown=shown: iter([shown]))
        assert script.main() == code
