"""Every broken file is refused with exactly the expected problems at exactly the expected places."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from duio_mesh.errors import ScenarioError
from tests.scenario.broken import CASES, VALID, Case
from tests.scenario.stand_in import load

LINE = re.compile(r"(?P<file>[^:]+):(?P<line>\d+):(?P<column>\d+): (?P<text>.+)")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_broken(case: Case, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError) as refused:
        load(case.write(tmp_path))
    found = []
    for problem in refused.value.problems:
        parts = LINE.fullmatch(problem)
        assert parts, problem
        found.append((Path(parts["file"]).name, int(parts["line"]), int(parts["column"]), parts["text"]))
    assert sorted(f[:3] for f in found) == sorted(e[:3] for e in case.expected), refused.value.problems
    for expected in case.expected:
        assert any(f[:3] == expected[:3] and expected.words in f[3] for f in found), refused.value.problems


def test_the_unbroken_file_is_accepted(tmp_path: Path) -> None:
    (tmp_path / "valid.yaml").write_text(VALID)
    assert load(tmp_path / "valid.yaml").name == "tiny"


def test_names_are_unique() -> None:
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names) >= 60
