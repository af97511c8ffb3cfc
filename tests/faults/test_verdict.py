"""What the command line says of a run whose nodes flag their estimates."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from duio_mesh.cli import main
from tests.conftest import TOPOLOGIES

CUT = "faults={cuts: [{edges: [[1, 2]], during: [%d, %d]}]}"


def said(capsys: pytest.CaptureFixture[str], *changes: str) -> tuple[int, str]:
    """Exit code and output, without line breaks."""
    sets = [word for change in changes for word in ("--set", change)]
    code = main([str(TOPOLOGIES / "ring.yaml"), "--in-process", "--no-record", "--steps", "100", "--out", "run", *sets])
    return code, " ".join(capsys.readouterr().out.split())


def test_converged_but_flagged_is_never_plainly_converged(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, words = said(capsys, CUT % (60, 100))
    assert code == 0, "the file's criterion is kept"
    assert "converged, but nodes 1, 2, 3 and 4 flag their last" in words
    metrics = json.loads(Path("run/metrics.json").read_text())
    assert (metrics["verdict"], metrics["converged"]) == ("converged", True)
    assert all(30 < node["flagged_last"] < 40 for node in metrics["nodes"].values())


def test_flags_that_are_over_are_no_word_beside_the_verdict(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, words = said(capsys, CUT % (20, 30))
    assert code == 0
    assert "converged: every node's RMS error" in words
    assert "warning: node-1 flags" in words


def test_not_converged_and_flagged_says_both(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, words = said(capsys, CUT % (60, 100), "run.convergence.rms_below=1e-9")
    assert code == 1
    assert "did not converge; nodes 1, 2, 3 and 4 flag their last" in words
