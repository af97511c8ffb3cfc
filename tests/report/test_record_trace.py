"""A finished trace as a recording, the page that describes it, and the example of docs/recording.md."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from synthetic import entities, read_series, read_texts

from duio_mesh.report import record_trace as module
from duio_mesh.report.description import describe
from duio_mesh.report.record_trace import record_trace
from duio_mesh.scenario.model import Arc, Convergence, Graph, Node, Noise, OpenLoop, Plant, Run, Scenario
from duio_mesh.trace import Trace

DOCS = Path(__file__).parents[2] / "docs" / "recording.md"


def make_scenario(n: int = 3) -> Scenario:
    """Three nodes on a directed path."""
    quiet = Noise(np.zeros((1, 0)), ())
    return Scenario(
        name="directed path",
        description="Three nodes | one pipe",
        plant=Plant(
            time="continuous",
            step=0.1,
            A=np.eye(n),
            B=np.ones((n, 1)),
            E=np.zeros((n, 2)),
            inputs=("pump",),
            x0=np.zeros(n),
            control=OpenLoop(((),)),
            disturbance=((), ()),
        ),
        method="lmi",
        options=None,
        nodes={i: Node(i, np.eye(n)[:1], ("pump",) if i == 1 else (), quiet) for i in (1, 2, 3)},
        graph=Graph((1, 2, 3), (Arc(1, 2, 1.0), Arc(2, 3, 1.0)), directed=True),
        run=Run(steps=50, seed=5, convergence=Convergence(0.25, 0.5), deadline=5.0, window=32),
        document={},
    )


def make_trace(**extra: Any) -> Trace:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((50, 3))
    xhat = x + 0.1 * rng.standard_normal((3, 50, 3))
    xhat[1, 30:] = np.nan  # node 2 was lost
    return Trace(t=np.arange(50) * 0.1, x=x, node_ids=np.array([1, 2, 3]), xhat=xhat, **extra)


def test_everything_of_the_trace_is_there_and_who_was_lost(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    trace = make_trace(what=rng.standard_normal((3, 50, 2)), vhat={3: rng.standard_normal((50, 1))})
    path = tmp_path / "recording.rrd"
    record_trace(path, make_scenario(), trace, "# A page")
    assert os.listdir(tmp_path) == ["recording.rrd"]
    assert trace.what is not None
    for i, K in ((1, 50), (2, 30), (3, 50)):
        for c in range(3):
            k, values = read_series(path, f"/state/x{c + 1}/node_{i}")
            assert k.tolist() == list(range(K))
            assert values.tobytes() == trace.xhat[i - 1, :K, c].tobytes()
        assert len(read_series(path, f"/error/node_{i}")[0]) == K
        values = read_series(path, f"/unknown_input/w2/node_{i}")[1]
        assert values[:K].tobytes() == trace.what[i - 1, :K, 1].tobytes()
    assert read_series(path, "/noise/node_3/v1")[1].tobytes() == trace.vhat[3].tobytes()
    assert read_series(path, "/state/x1/actual", "sim_time")[0].tolist() == [k * 10**8 for k in range(50)]
    assert read_texts(path, "/alive/node_2", "StateChange:state") == [(0, "up"), (30, "down")]
    assert read_texts(path, "/alive/node_3", "StateChange:state") == [(0, "up")]
    arrows = [c for c in RrdReader(path).stream().filter(content="/mesh/edges/**") if c.is_static]
    assert len(arrows) == 2
    assert all("Arrows2D:vectors" in chunk.to_record_batch().schema.names for chunk in arrows)
    assert not any(entity.startswith("/rates/") and n > 1 for entity, n in entities(path).items())


def test_a_torn_recording_is_replaced_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "recording.rrd"
    path.write_bytes(b"torn")

    def fail(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr(module.Recording, "fill", fail)
        with pytest.raises(OSError, match="no space"):
            record_trace(path, make_scenario(), make_trace())
    assert path.read_bytes() == b"torn"
    assert os.listdir(tmp_path) == ["recording.rrd"]
    record_trace(path, make_scenario(), make_trace())
    assert len(read_series(path, "/error/node_1")[0]) == 50


def test_the_page_says_what_was_run_and_what_is_promised() -> None:
    certificate = {
        "conditions": {"rank": {"value": 0.5, "threshold": 1e-9, "ok": True}, "beta": {"value": 2.0, "ok": False}},
        "nodes": {i: {f"figure {j}": i + j / 8 for j in range(9)} for i in (1, 2, 3)},
        "spectral_radius": 0.928729999,
        "g": [0.33, 0.34],
        "who": None,
    }
    page = describe(make_scenario(), certificate)
    lines = page.splitlines()
    assert lines[0] == "# directed path"
    assert "is below 0.25" in page
    assert "| 1 | 1 | pump |  |" in lines
    assert "| 2 | 1 | nothing | 1 |" in lines
    assert "| rank | 0.5 | 1e-09 | yes |" in lines
    assert "| beta | 2 | - | no |" in lines
    assert "| spectral_radius | 0.92873 |" in lines
    assert "| g | 0.33, 0.34 |" in lines
    assert any(line.startswith("| 3 | 3.875 | 4 |") for line in lines), "the second table of the nodes"
    tables = re.findall(r"(?:^\|.*\|\n)+", page, re.MULTILINE)
    for table in tables:
        columns = {len(re.findall(r"(?<!\\)\|", line)) for line in table.splitlines()}
        assert len(columns) == 1, f"a row of this table has more cells than its head:\n{table}"
    assert certificate["spectral_radius"] == 0.928729999, "the certificate itself is left alone"
    assert "## Conditions" not in describe(make_scenario(), {})


def test_the_example_of_the_documentation_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = make_trace()
    record_trace(tmp_path / "recording.rrd", make_scenario(), trace)
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    found: dict[str, Any] = {}
    exec(code, found)  # the page's own lines
    assert found["k"].tolist() == list(range(50))
    np.testing.assert_allclose(10 ** found["error"], np.linalg.norm(trace.xhat[0] - trace.x, axis=1))
    t, x2 = found["read_series"]("recording.rrd", "/state/x2/actual", "sim_time")
    assert t[1] == 10**8
    assert x2.tobytes() == np.ascontiguousarray(trace.x[:, 1]).tobytes()


def test_the_documentation_names_the_entities_that_there_are(tmp_path: Path) -> None:
    flags = np.zeros((3, 50), dtype=bool)
    trace = make_trace(what=np.ones((3, 50, 1)), vhat={3: np.ones((50, 1))}, flagged=flags)
    record_trace(tmp_path / "r.rrd", make_scenario(), trace)
    there = set(entities(tmp_path / "r.rrd"))
    table = [line for line in DOCS.read_text().splitlines() if line.startswith("| `/")]
    named = [name for line in table for name in re.findall(r"`(/[\w/]+)[^`]*`", line.split("|")[1])]
    assert len(named) == 13
    elsewhere = {
        "/rates/node_3",
        "/missing/node_3",
        "/rounds/residual/node_3",
        "/rounds/disagreement/node_3",
    }  # while a mesh runs; watched
    for name in set(named) - elsewhere:
        assert any(path == name or path.startswith(name) for path in there), f"{name} is not in a recording"
