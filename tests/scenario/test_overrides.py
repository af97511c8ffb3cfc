"""--set path=value: applied to the resolved file, checked like it, and named in every problem that it causes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import duio_mesh
from duio_mesh.errors import ScenarioError
from duio_mesh.scenario.model import OpenLoop
from tests.scenario.broken import PLANT_FILE, VALID, without
from tests.scenario.stand_in import Poles, load


@pytest.fixture
def topology(tmp_path: Path) -> Path:
    """The valid file, with its plant in a file of its own."""
    (tmp_path / "plant.yaml").write_text(PLANT_FILE)
    (tmp_path / "other.yaml").write_text(PLANT_FILE.replace("0.1", "0.3"))
    (tmp_path / "t.yaml").write_text(VALID.replace(without("plant:", "observer:"), "plant: plant.yaml\n"))
    return tmp_path / "t.yaml"


def test_values_are_replaced(topology: Path) -> None:
    s = load(
        topology,
        "run.steps=7",
        "plant.noise.variance=4",
        "plant.A.0.1=0.2",
        "nodes.2.knows=[heater]",
        "observer.local_gain={poles: [0.1, 0.2]}",
        "graph={arcs: [[1, 2]]}",
        "run.deadline=1.5",
        "description=a=b: c".replace(": ", " "),
        "run.steps=8",
    )
    assert (s.run.steps, s.run.deadline, s.description) == (8, 1.5, "a=b c")
    assert s.plant.A[0, 1] == 0.2
    assert s.nodes[2].knows == ("heater",)
    assert s.nodes[2].noise.signals == (({"normal": {"mean": 0.0, "std": 2.0}},),)
    assert s.options.local_gain == Poles(poles=(0.1, 0.2))
    assert s.graph.directed
    assert s.document["run"]["steps"] == 8
    assert s.document["plant"]["noise"] == {"variance": 4}


def test_the_python_interface_takes_numpy(topology: Path) -> None:
    changes = {"plant.A": np.eye(2) / 2, "run.steps": np.int64(5), "plant.noise": {"variance": np.float32(0.25)}}
    s = duio_mesh.load_scenario(topology, **changes, **{"observer.local_gain": "hinf"})
    assert np.array_equal(s.plant.A, np.eye(2) / 2)
    assert s.run.steps == 5
    with pytest.raises(TypeError, match="no form for object"):
        duio_mesh.load_scenario(topology, **{"plant.A": object()})


def test_keys_are_added_and_emptied(topology: Path) -> None:
    s = load(
        topology, "nodes.3={C: [[1, 1]]}", "graph.edges=[[1, 3]]", "plant.control={signals: [1]}", "plant.control="
    )
    assert list(s.nodes) == [1, 2, 3]
    assert s.plant.control == OpenLoop(((),))


def test_another_plant_file(topology: Path) -> None:
    assert np.array_equal(load(topology, "plant=other.yaml", "plant.A.0.0=0").plant.A, [[0, 0.3], [0, 0.5]])


def test_an_override_can_mend_a_file(topology: Path) -> None:
    topology.write_text(topology.read_text().replace("steps: 10", "steps: -10"))
    assert load(topology, "run.steps=3").run.steps == 3


@pytest.mark.parametrize(
    ("override", "problems"),
    [
        ("run.steps=x", ["run.steps: should be a whole number, not the text 'x'"]),
        ("run.steps=0", ["run.steps: should be at least 1, not 0"]),
        ("run.steps=", ["run.steps: should be a whole number, not nothing"]),
        ("run.stepps=1", ["run.stepps: unknown key (did you mean steps?)"]),
        ("rum.steps=1", ["rum: unknown key (did you mean run?)"]),
        ("run={}", ["run.steps: is missing", "run.convergence: is missing"]),
        ("plant.A.0.1=.nan", ["plant.A.0.1: should be a finite number, not .nan"]),
        ("plant.A.0.2=1", ["plant.A.0: has 2 entries; there is no 2 (the first one is 0)"]),
        ("plant.A.x=1", ["plant.A: has 2 entries; there is no x (the first one is 0)"]),
        ("plant.A.0=[1]", ["plant.A.0: should have 2 entries (A is square), not 1"]),
        ("plant.period.x=1", ["plant.period: is 1.0; there is no x in it"]),
        ("plant.x0=[1]", ["plant.x0: should have 2 entries (one per state), not 1"]),
        ("plant.noise=0.5", ["plant.noise: say what 0.5 is: {variance: 0.5} or {std: 0.5}"]),
        ("plant.noise.varience=1", ["plant.noise.varience: unknown key (did you mean variance?)"]),
        ("plant=nowhere.yaml", ["plant: no such file: "]),
        ("nodes.9.noise=0", ["nodes.9: no such node; the nodes are 1 and 2"]),
        ("nodes.one.noise=0", ["nodes.one: no such node; the nodes are 1 and 2"]),
        ("nodes.2.C=[[1]]", ["nodes.2.C.0: should have 2 entries (one per state), not 1"]),
        ("nodes.2.C.0=[1, 0, 0]", ["nodes.2.C.0: should have 2 entries (one per state), not 3"]),
        ("graph.edges=[[1, 2], [2, 1]]", ["graph.edges.1: [2, 1] is an edge already"]),
        ("timing={}", ["timing.mode: is missing"]),
        ("run.seed=[1", ["run.seed: is not valid YAML"]),
        ("run.seed={a: 1, a: 2}", ["run.seed.a: is given twice", "run.seed: should be a whole number"]),
        ("run.seed=&x 1", ["run.seed: anchors (&x) are not allowed"]),
        ("run.seed=\x1b[31m", ["run.seed: is not text: it holds the control character U+001B"]),
        ("run.steps", ["should read path=value"]),
        ("=3", ["should read path=value"]),
        ("run..steps=3", ["should read path=value"]),
    ],
)
def test_problems_name_the_argument(topology: Path, override: str, problems: list[str]) -> None:
    with pytest.raises(ScenarioError) as refused:
        load(topology, override)
    shown = override.replace("\x1b", "\\x1b")
    assert len(refused.value.problems) == len(problems), refused.value.problems
    for text in problems:
        assert any(p.startswith(f"--set {shown}: {text}") for p in refused.value.problems), refused.value.problems


def test_file_and_argument_are_told_apart(topology: Path) -> None:
    topology.write_text(topology.read_text().replace("seed: 0", "seed: -5"))
    with pytest.raises(ScenarioError) as refused:
        load(topology, "run.steps=0")
    assert sorted(refused.value.problems) == [
        "--set run.steps=0: run.steps: should be at least 1, not 0",
        f"{topology}:14:9: run.seed: should be at least 0, not -5",
    ]
