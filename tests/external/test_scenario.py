"""``external:`` in a topology file: what it comes to, and what is refused where."""

from __future__ import annotations

import re
from math import inf
from pathlib import Path

import pytest

from duio_mesh.errors import ScenarioError
from duio_mesh.scenario import scenario_yaml
from duio_mesh.scenario.model import Scenario
from duio_mesh.spec import Outside
from tests.conftest import ROOT, TOPOLOGIES
from tests.scenario.broken import PLANT_FILE
from tests.scenario.same import same
from tests.scenario.stand_in import load

FILE = """\
name: tiny
plant: external
external:
  model: plant.yaml
  key: hall/{node}/y
observer: {method: lmi}
nodes:
  1: {C: [[1, 0], [0, 1]], knows: [heater]}
  7: {C: [[0, 1]]}
graph: {edges: [[1, 7]]}
run: {steps: 10, convergence: {rms_below: 0.5}}
"""


def written(folder: Path, *edits: tuple[str, str]) -> Path:
    text = FILE
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "plant.yaml").write_text(PLANT_FILE)
    (folder / "tiny.yaml").write_text(text)
    return folder / "tiny.yaml"


def outside(scenario: Scenario) -> Outside:
    assert scenario.outside is not None
    return scenario.outside


def test_a_template_gives_every_node_a_key(tmp_path: Path) -> None:
    scenario = load(written(tmp_path))
    assert outside(scenario) == Outside(
        listen="tcp/127.0.0.1:7447",
        connect="",
        encoding="json",
        feeds={1: ("hall/1/y",), 7: ("hall/7/y",)},
        sizes={"hall/1/y": 3, "hall/7/y": 1},
        strays="hall/*/y",
        end="",
        hold=inf,
        start_within=60.0,
    )
    assert outside(scenario).widths() == {1: 3, 7: 1}
    (tmp_path / "again.yaml").write_text(scenario_yaml(scenario, {}))
    assert same(load(tmp_path / "again.yaml"), scenario)


def test_any_topology_can_be_fed_from_outside_by_an_argument(tmp_path: Path) -> None:
    path = written(
        tmp_path, ("plant: external\nexternal:\n  model: plant.yaml\n  key: hall/{node}/y", "plant: plant.yaml")
    )
    assert load(path).outside is None
    found = outside(load(path, "external={key: 'x/{node}', connect: tcp/router:7447, hold: 2}"))
    assert (found.listen, found.connect, found.hold) == ("", "tcp/router:7447", 2.0)
    assert found.feeds == {1: ("x/1",), 7: ("x/7",)}


def test_nodes_with_keys_of_their_own(tmp_path: Path) -> None:
    keys = "C: [[1, 0], [0, 1]], keys: [a/*, shared, u]"
    path = written(tmp_path, ("C: [[1, 0], [0, 1]]", keys), ("C: [[0, 1]]", "C: [[0, 1]], keys: shared"))
    found = outside(load(path))
    assert found.feeds == {1: ("a/*", "shared", "u"), 7: ("shared",)}
    assert found.sizes == {"a/*": 1, "shared": 1, "u": 1}


def test_a_key_for_all_is_one_mistake_unless_one_node_uses_it(tmp_path: Path) -> None:
    misspelt = written(tmp_path, ("hall/{node}/y", "hall/{nod}/y"))
    with pytest.raises(ScenarioError) as refused:
        load(misspelt)
    (problem,) = refused.value.problems
    assert problem.endswith("tiny.yaml:5:8: external.key: {nod} is not replaced by anything (did you mean {node}?)")
    alone = written(tmp_path, ("hall/{node}/y", "hall"), ("C: [[0, 1]]", "C: [[0, 1]], keys: b"))
    assert outside(load(alone)).feeds == {1: ("hall",), 7: ("b",)}


LOOSE = ("  key: hall/{node}/y\n", "  key: hall/{node}/y\n  listen: tcp/0.0.0.0:7447\n")


def test_listening_beyond_this_host_has_to_be_said(tmp_path: Path) -> None:
    path = written(tmp_path, LOOSE)
    with pytest.raises(ScenarioError, match=r"external\.listen: lets everybody who reaches that port"):
        load(path)
    assert outside(load(path, "external.exposed=true")).listen == "tcp/0.0.0.0:7447"
    assert outside(load(path, "external.listen='tcp/[::1]:7447'")).listen == "tcp/[::1]:7447"


@pytest.mark.parametrize(
    ("edits", "problem"),
    [
        ([("  model: plant.yaml\n", "")], "tiny.yaml:2:8: plant: external needs 'external: {model: FILE"),
        ([("model: plant.yaml", "model: plants.yaml")], "tiny.yaml:4:10: plant: no such file"),
        ([("  key: hall/{node}/y\n", "")], "tiny.yaml:7:3: nodes.1.keys: is missing: external.key is not given"),
        ([("hall/{node}/y", "hall//{node}")], "tiny.yaml:5:8: external.key: should be a Zenoh key"),
        ([("hall/{node}/y", "hall/**")], "tiny.yaml:5:8: external.key: should be a Zenoh key"),
        ([("hall/{node}/y", "hall")], "tiny.yaml:5:8: external.key: should have {node} in it: 2 nodes have no keys"),
        (
            [("hall/{node}/y", "'{id}/{node}'")],
            "tiny.yaml:5:8: external.key: {id} is not replaced by anything; only {node}",
        ),
        (
            [("C: [[1, 0], [0, 1]]", "C: [[1, 0], [0, 1]], keys: a"), ("C: [[0, 1]]", "C: [[0, 1]], keys: a")],
            "tiny.yaml:9:20: nodes.7.keys: a carries 3 of another node's numbers, and 1",
        ),
        (
            [("C: [[0, 1]]", "C: [[0, 1]], keys: [a, b]")],
            "tiny.yaml:9:26: nodes.7.keys: should be one key for all numbers, or 1 (1 measurement), not 2",
        ),
        (
            [("  key: hall/{node}/y\n", "  key: hall/{node}/y\n  encoding: sensor_msgs/Temperature\n")],
            "tiny.yaml:9:3: nodes.1.keys: should be a list of 3 (2 measurements and 1 input): a sensor_msgs/",
        ),
        ([("hall/{node}/y", "a\n  encoding: cdr")], "tiny.yaml:6:13: external.encoding: should be 'json', 'float64'"),
        ([("hall/{node}/y", "a\n  listen: 127.0.0.1")], "tiny.yaml:6:11: external.listen: should be a Zenoh endpoint"),
        ([("hall/{node}/y", "a\n  connect: tcp/x:99999")], "external.connect: should be a Zenoh endpoint"),
        (
            [("hall/{node}/y", "a\n  listen: tcp/localhost:1\n  connect: tcp/x:1")],
            "tiny.yaml:7:3: external.connect: give either listen or connect, not both",
        ),
        ([("hall/{node}/y", "a\n  hold: 5")], "tiny.yaml:6:9: external.hold: should be less than run.deadline, 5 s"),
        ([("hall/{node}/y", "hall/{node}/y\n  end: hall/7/y")], "tiny.yaml:6:8: external.end: is the key of a sensor"),
        ([("steps: 10", "steps: 10, batch: 2")], "run.batch: should be 1: samples from outside come one by one"),
        (
            [("run:", "timing: realtime\nrun:")],
            "timing: should be lockstep: with plant: external the sensors set the pace",
        ),
        ([("plant: external", "plant: plant.yaml")], "tiny.yaml:4:3: external.model: belongs to 'plant: external'"),
        (
            [
                ("plant: external\nexternal:\n  model: plant.yaml\n  key: hall/{node}/y", "plant: plant.yaml"),
                ("C: [[0, 1]]", "C: [[0, 1]], keys: a"),
            ],
            "nodes.7.keys: belongs to plant: external",
        ),
    ],
)
def test_what_is_refused(tmp_path: Path, edits: list[tuple[str, str]], problem: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        load(written(tmp_path, *edits))
    assert any(problem in found for found in refused.value.problems), refused.value.problems


def test_the_page_shows_what_loads(tmp_path: Path) -> None:
    """Every YAML block of docs/sensors.md and of the section in docs/topology-file.md, with what a whole file needs."""
    page = (ROOT / "docs" / "sensors.md").read_text() + (ROOT / "docs" / "topology-file.md").read_text()
    blocks = [
        b for b in re.findall(r"^```yaml\n(.*?)^```$", page, re.M | re.S) if "keys:" in b or "plant: external" in b
    ]
    assert len(blocks) == 3
    for block in blocks:
        text = block
        for key, rest in {
            "plant": "plant: external\nexternal: {model: plants/heat9.yaml}\n",
            "name": "name: page\n",
            "observer": "observer: {method: lmi}\n",
            "nodes": "nodes: {1: {C: [[0, 0, 0, 0, 1, 0, 0, 0, 0]]}}\n",
            "graph": "graph: {edges: []}\n",
            "run": "run: {steps: 10, convergence: {rms_below: 1}}\n",
        }.items():
            text += "" if re.search(rf"^{key}:", block, re.M) else rest
        (tmp_path / "page.yaml").write_text(text)
        (tmp_path / "plants").mkdir(exist_ok=True)
        (tmp_path / "plants" / "heat9.yaml").write_text((TOPOLOGIES / "plants" / "heat9.yaml").read_text())
        assert load(tmp_path / "page.yaml").outside
