"""docs/topology-file.md: its examples load, its messages are real, and no key is missing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from duio_mesh.errors import ScenarioError
from duio_mesh.scenario import schema
from tests.conftest import ROOT, TOPOLOGIES
from tests.scenario.broken import VALID
from tests.scenario.stand_in import load

PAGE = (ROOT / "docs" / "topology-file.md").read_text(encoding="utf-8")
MODELS = [m for m in vars(schema).values() if isinstance(m, type) and issubclass(m, BaseModel) and m.model_fields]


def blocks(language: str) -> list[str]:
    """The fenced blocks of the page in this language."""
    fenced = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return [text for kind, text in fenced if kind == language]


def test_the_complete_example_loads(tmp_path: Path) -> None:
    (tmp_path / "t.yaml").write_text(blocks("yaml")[0])
    assert load(tmp_path / "t.yaml").name == "two-tanks"


def test_the_signal_example_loads(tmp_path: Path) -> None:
    line = blocks("yaml")[1].split("#")[0].strip()
    (tmp_path / "t.yaml").write_text(VALID.replace("disturbance: [{constant: {value: 1}}]", line))
    assert len(load(tmp_path / "t.yaml").plant.disturbance[0]) == 3


def test_the_messages_are_real(tmp_path: Path) -> None:
    """The mistakes behind the page's messages, made in the real files."""
    (tmp_path / "topologies" / "plants").mkdir(parents=True)
    heat = (TOPOLOGIES / "plants" / "heat9.yaml").read_text()
    (tmp_path / "topologies" / "plants" / "heat9.yaml").write_text(heat.replace("period: 60.0", "perod: 60.0"))
    ring = (TOPOLOGIES / "ring.yaml").read_text()
    ring = ring.replace("observability", "observabilty").replace(
        "0, 0, 1]]\n    knows: [hvac2]", "0, 1]]\n    knows: [hvac2]"
    )
    (tmp_path / "topologies" / "ring.yaml").write_text(ring)
    with pytest.raises(ScenarioError) as refused:
        load(Path("topologies/ring.yaml"), "run.steps=0")
    shown = next(b for b in blocks("") if "did you mean" in b)
    assert shown.splitlines() == refused.value.problems


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.__name__)
def test_every_key_is_on_the_page(model: type[BaseModel]) -> None:
    for key in model.model_fields:
        assert re.search(rf"\b{key}\b", PAGE), key
