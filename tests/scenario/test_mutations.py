"""Whatever is done to a file, the answer is a Scenario or a ScenarioError with a place on every line; nothing else."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from ruamel.yaml import YAML

from duio_mesh.errors import ScenarioError
from duio_mesh.scenario import scenario_yaml
from tests.scenario.broken import VALID
from tests.scenario.same import same
from tests.scenario.stand_in import load

FULL = VALID.replace(
    "{signals: {heater: {sine: {amplitude: 1, period: 10}}}}", "{lqr: {Q: [1, 2], R: 1, reference: [0, 0]}}"
)
FULL = FULL.replace(
    "[{constant: {value: 1}}]", "[[1, {sine: {rate: 2}}, {normal: {std: 1}}, {step: {time: 1, after: 2}}]]"
)
FULL = FULL.replace("knows: []", "noise: {channel: [[1, 2]], signals: [0, {square: {period: 3}}]}")
FULL = FULL.replace("edges: [[1, 2]]", "edges: [[1, 2, 0.5]]").replace(
    "x0: [1.0, 0.0]", "x0: {normal: {mean: 1, std: [1, 2]}}"
)

Document = dict[Any, Any]


def plain(text: str) -> Document:
    """The file as dicts and lists."""
    document: Document = YAML(typ="safe", pure=True).load(text)
    return document


def flow(value: Any) -> str:
    """YAML on one line; unlike JSON it writes NaN and infinities as YAML does."""
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{k if isinstance(k, int) else json.dumps(k)}: {flow(v)}" for k, v in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(flow(v) for v in value) + "]"
    if isinstance(value, float) and not abs(value) < float("inf"):
        return ".nan" if value != value else f"{'-' if value < 0 else ''}.inf"
    return json.dumps(value)


def paths(value: Any, here: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Every place in a document."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [here, *(p for k, v in inner for p in paths(v, (*here, k)))]


def reach(value: Any, path: tuple[Any, ...]) -> Any:
    for part in path:
        value = value[part]
    return value


def check(text: str | bytes, folder: Path) -> bool:
    """Is the file accepted? It must be accepted again after resolving, or refused with a place on every line."""
    path = folder / "t.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    try:
        scenario = load(path)
    except ScenarioError as e:
        problems = e.problems
    else:
        resolved = folder / "scenario.yaml"
        resolved.write_text(scenario_yaml(scenario, {}), encoding="utf-8")
        assert same(load(resolved), scenario)
        return True
    assert problems
    for problem in problems:
        assert re.fullmatch(rf"{re.escape(str(folder))}/[^:]*:[1-9]\d*:[1-9]\d*: .+", problem), problem
    return False


PLACES = [p for p in paths(plain(FULL)) if p]
JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 3),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from(
        [[], {}, [[]], [{}], [[1, 2], [3]], {"normal": {}}, {"sine": 1}, "heater", "lmi", {"a": {"b": []}}]
    ),
    st.sampled_from(PLACES).map(lambda p: copy.deepcopy(reach(plain(FULL), p))),
)
MUTATION = st.tuples(st.sampled_from(["replace", "delete", "repeat", "rename"]), st.sampled_from(PLACES), JUNK)
SETTINGS = settings(
    deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


def mutate(document: Document, how: str, path: tuple[Any, ...], junk: Any) -> None:
    """One change in place; nothing when an earlier change took the place away."""
    try:
        around = reach(document, path[:-1])
        value = around[path[-1]]
    except (KeyError, IndexError, TypeError):
        return
    if how == "replace" or not isinstance(around, dict | list):
        around[path[-1]] = junk
    elif how == "delete":
        del around[path[-1]]
    elif how == "repeat":
        around[path[-1]] = [value, value]
    elif isinstance(around, dict):
        around[str(junk)[:8]] = around.pop(path[-1])


def test_the_full_file_is_accepted(tmp_path: Path) -> None:
    assert check(FULL, tmp_path)
    assert check(flow(plain(FULL)), tmp_path)


@settings(SETTINGS, max_examples=200)
@given(mutations=st.lists(MUTATION, min_size=1, max_size=3))
def test_mutated_documents(tmp_path: Path, mutations: list[tuple[str, tuple[Any, ...], Any]]) -> None:
    document = plain(FULL)
    for mutation in mutations:
        mutate(document, *mutation)
    check(flow(document), tmp_path)


@settings(SETTINGS, max_examples=300)
@given(
    at=st.integers(0, len(FULL)),
    cut=st.integers(0, 12),
    put=st.one_of(st.text(max_size=4), st.text("[]{}:,-&*!|>'\"#%@` \n\t?~.1e", max_size=5)),
)
@example(at=0, cut=len(FULL), put="")
@example(at=0, cut=0, put="\ufeff\ufeff")
@example(at=FULL.index("10\n"), cut=2, put='"\\ud800"')
@example(at=FULL.index("tiny"), cut=4, put='"\\ud800"')
@example(at=FULL.index("steps"), cut=5, put='"\\x07"')
@example(at=FULL.index("steps"), cut=5, put='"a\\nb"')
def test_mutated_texts(tmp_path: Path, at: int, cut: int, put: str) -> None:
    text = FULL[:at] + put + FULL[at + cut :]
    check(text.encode("utf-8", "surrogatepass"), tmp_path)


@settings(SETTINGS, max_examples=100)
@given(st.binary(max_size=60))
@example(b"\x80")
@example(b"{" * 1000)
@example(b"- " * 1000)
@example(b"? " * 1000)
def test_any_bytes(tmp_path: Path, data: bytes) -> None:
    assert not check(data, tmp_path)
