"""`launch.py gather` with nothing to gather writes nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from duio_mesh import cli
from tests.conftest import TOPOLOGIES


@pytest.mark.parametrize(
    ("folder", "code", "said"),
    [("nowhere", 2, "nowhere: no such folder"), ("empty", 3, "nothing to gather: no journal (plant.f64, node-*.f64)")],
)
def test_nothing_to_gather(folder: str, code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(TOPOLOGIES / "ring.yaml"), "--dry-run", "--out", "site"]) == 0
    before = sorted(Path("site").rglob("*"))
    Path("empty").mkdir()
    assert cli.main(["gather", "site", folder]) == code
    assert said in capsys.readouterr().err
    assert sorted(Path("site").rglob("*")) == before
