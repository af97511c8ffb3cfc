"""`launch.py new`: what it writes, what it refuses, and that the same order writes the same file."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from duio_mesh.cli import main
from duio_mesh.generate import graphs, heat, platoon, swing
from duio_mesh.generate.document import Document, text
from duio_mesh.scenario import load_scenario
from duio_mesh.synthesis import options_of
from tests.conftest import ROOT

ORDERS = [
    "heat --rooms 8x8 --nodes 16 --graph grid",
    "heat --rooms 8x8 --nodes 64 --graph random --seed 4 --method augmented",
    "platoon --vehicles 32 --graph random",
    "platoon --vehicles 64",
    "swing --case 39 --loads 3 --graph random",
]


def new(order: str, path: str) -> str:
    assert main(["new", *shlex.split(order), "--out", path]) == 0
    return Path(path).read_text(encoding="utf-8")


@pytest.mark.parametrize("order", ORDERS)
def test_the_same_order_writes_the_same_file(order: str, capsys: pytest.CaptureFixture[str]) -> None:
    first = new(order, "a.yaml")
    remembered = first.splitlines()[0].removeprefix("# Made by: python launch.py new ")
    capsys.readouterr()
    assert main(["new", *shlex.split(remembered)]) == 0
    assert capsys.readouterr().out == first
    assert max(len(line) for line in first.splitlines() if line.lstrip().startswith("#")) <= 120


def test_another_seed_is_another_building() -> None:
    order = "heat --rooms 3x3 --nodes 4"
    assert new(order, "a.yaml") != new(f"{order} --seed 1", "b.yaml").replace(" --seed 1", "")


@pytest.mark.parametrize(
    "document",
    [
        heat.document(heat.Heat(4, 5, 6, graph="random", own_rooms=2)),
        heat.document(heat.Heat(8, 8, 16)),
        platoon.document(platoon.Platoon(5)),
        swing.document(swing.Swing(39, loads=2)),
        swing.document(swing.Swing(14, method="augmented")),
    ],
    ids=lambda document: document.content["name"],
)
def test_every_number_is_read_back_bit_for_bit(document: Document) -> None:
    Path("a.yaml").write_text(text(document), encoding="utf-8")
    s = load_scenario("a.yaml", options_of=options_of)
    for key in ("A", "B", "E"):
        assert np.array_equal(getattr(s.plant, key), document.content["plant"][key])
    assert {i: node.C.tolist() for i, node in s.nodes.items()} == {
        i: node["C"].tolist() for i, node in document.content["nodes"].items()
    }


PRINTABLE = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]) | st.just(" "), max_size=20)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(
    st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=10),
    PRINTABLE | st.sampled_from(["true", "null", "1e3", "a: b", "no", "", "~", "- x"]),
)
def test_any_number_and_any_text_survive(numbers: list[float], words: str) -> None:
    read = YAML(typ="safe", pure=True).load(text(Document({"a": numbers, "b": {"c": words}}, "", {})))
    assert [float(v) for v in read["a"]] == numbers
    assert read["b"]["c"] == words


@pytest.mark.parametrize(
    ("order", "said"),
    [
        ("heat --rooms 0x3 --nodes 1", "--rooms: should be rows x columns, each at least 1, like 8x8, not '0x3'"),
        ("heat --rooms 3 --nodes 1", "--rooms"),
        ("heat --rooms 1x1 --nodes 1", "--rooms: a building should have at least two rooms"),
        ("heat --rooms 50x50 --nodes 1", "2500 rooms are too many"),
        ("heat --rooms 3x3 --nodes 10", "--nodes: should be between 1 and 9, the number of rooms, not 10"),
        ("heat --rooms 3x3 --nodes 0", "--nodes: should be between 1 and 9"),
        ("heat --rooms 3x3 --nodes -1", "--nodes"),
        ("heat --rooms 3x3 --nodes 2 --hvac 9", "--hvac: should be between 1 and 8"),
        ("heat --rooms 3x3 --nodes 2 --own-rooms 9", "--own-rooms: should be between 0 and 7"),
        ("heat --rooms 3x3 --nodes 2 --graph cube", "--graph: invalid choice: 'cube'"),
        ("heat --rooms 3x3 --nodes 2 --method admm", "--method: invalid choice: 'admm'"),
        ("heat --nodes 2", "--rooms"),
        ("platoon --vehicles 1", "--vehicles: should be between 2 and 500, not 1"),
        ("platoon --vehicles 1.5", "--vehicles: should be a whole number"),
        ("swing --case 30", "--case: invalid choice: 30"),
        ("swing --case 14 --nodes 5", "--nodes: should be between 1 and 4"),
        ("swing --case 39 --nodes 4", "--nodes: should be at least 9, not 4"),
        ("swing --case 39 --loads 4", "--loads: should be between 1 and 3, not 4"),
        ("tram --cars 3", "invalid choice: 'tram'"),
        ("", "KIND"),
    ],
)
def test_what_makes_no_sense_exits_2_and_writes_nothing(
    order: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(["new", *order.split(), *(["--out", "a.yaml"] if order else [])])
    except SystemExit as end:  # argparse
        code = int(end.code or 0)
    assert code == 2
    assert said in capsys.readouterr().err
    assert not list(Path().iterdir())


def test_an_existing_file_is_never_overwritten(capsys: pytest.CaptureFixture[str]) -> None:
    Path("mine.yaml").write_text("precious")
    assert main(["new", "platoon", "--vehicles", "3", "--out", "mine.yaml"]) == 2
    assert "--out mine.yaml: already exists" in capsys.readouterr().err
    assert Path("mine.yaml").read_text() == "precious"


def test_a_place_that_cannot_be_written_exits_2(capsys: pytest.CaptureFixture[str]) -> None:
    Path("file").write_text("")
    assert main(["new", "platoon", "--vehicles", "3", "--out", "file/a.yaml"]) == 2
    assert "--out file/a.yaml: cannot be written" in capsys.readouterr().err


def test_without_pypower_swing_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pypower.case14", None)
    assert main(["new", "swing", "--case", "14"]) == 2
    assert "duio_mesh[grid]" in capsys.readouterr().err


def test_the_first_line_names_the_schema_where_there_is_one() -> None:
    Path("schema.json").write_text("{}")
    assert new("platoon --vehicles 2", "a.yaml").startswith("# yaml-language-server: $schema=schema.json\n# Made by")
    assert new("platoon --vehicles 2", "big/a.yaml").startswith("# yaml-language-server: $schema=../schema.json\n")
    assert new("platoon --vehicles 2", "very/big/a.yaml").startswith("# Made by")


def test_the_real_command() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), "new", "heat", "--rooms", "2x2", "--nodes", "2"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "name: heat-2x2-2-ring\n" in done.stdout


@pytest.mark.parametrize("N", [1, 2, 3, 4, 7, 16, 64])
@pytest.mark.parametrize("name", graphs.NAMES)
def test_graphs_are_connected_and_simple(name: str, N: int) -> None:
    edges = graphs.edges(name, N, np.random.default_rng(N))
    assert len(set(edges)) == len(edges)
    assert all(1 <= i < j <= N for i, j in edges)
    L = np.zeros((N, N))
    for i, j in edges:
        L[i - 1, j - 1] = L[j - 1, i - 1] = -1
    L -= np.diag(L.sum(axis=1))
    assert N == 1 or np.linalg.eigvalsh(L)[1] > 1e-6
    degrees = np.diag(L)
    if N >= 4:
        expected = {"ring": (2, 2), "path": (1, 2), "grid": (1, 4), "star": (1, N - 1)}.get(name, (1, N - 1))
        assert degrees.min() >= expected[0]
        assert degrees.max() <= expected[1]
        assert name != "ring" or len(edges) == N
        assert name != "random" or len(edges) >= N
