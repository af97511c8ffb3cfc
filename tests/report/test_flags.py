"""Marked estimates and steps without any, as a recording and the figures show them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader
from synthetic import entities, make_rows, make_spec, read_series, read_texts
from test_record_trace import make_scenario

from duio_mesh.arrays import Array
from duio_mesh.report.entities import STATES
from duio_mesh.report.figures import SHADE, figures
from duio_mesh.report.record_trace import record_trace
from duio_mesh.report.recording import Recording
from duio_mesh.report.trace_file import read_trace, write_trace
from duio_mesh.spec import RecorderSpec
from duio_mesh.trace import Trace

COLUMN = "StateChange:state"


def marked(path: Path, steps: int = 100) -> tuple[RecorderSpec, Array, dict[int, Array]]:
    """Two nodes of which the second flags the steps 30 to 44 and 70."""
    spec = make_spec(path, nodes=2, n=3, steps=steps, extra=1, flags=True)
    truth, rows = make_rows(spec)
    for i in rows:
        rows[i][:, -1] = 0.0
    rows[2][30:45, -1] = rows[2][70:71, -1] = 1.0
    return spec, truth, rows


def lane(path: Path, node: int, steps: int) -> list[str]:
    """What the lane shows at every step: the latest change counts."""
    found, changes = [""] * steps, read_texts(path, f"/flag/node_{node}", COLUMN)
    for k, state in changes:
        found[k:] = [state] * (steps - k)
    return found


def words(marks: Array) -> list[str]:
    return ["flagged" if mark else "trusted" for mark in marks]


def test_the_lane_changes_where_the_marks_do_and_nowhere_else(tmp_path: Path) -> None:
    spec, truth, rows = marked(tmp_path / "r.rrd")
    with Recording(spec) as recording:
        for k in range(0, 100, 7):
            recording.truth(k, truth[k : k + 7])
            for i in rows:
                recording.estimates(i, k, rows[i][k : k + 7])
    path = tmp_path / "r.rrd"
    assert read_texts(path, "/flag/node_1", COLUMN) == [(0, "trusted")]
    assert read_texts(path, "/flag/node_2", COLUMN) == [
        (0, "trusted"),
        (30, "flagged"),
        (45, "trusted"),
        (70, "flagged"),
        (71, "trusted"),
    ]
    assert not any(name.startswith("/noise") for name in entities(path)), "the mark is no reconstructed noise"
    assert read_series(path, "/state/x3/node_2")[1].tobytes() == np.ascontiguousarray(rows[2][:, 2]).tobytes()


@pytest.mark.parametrize("seed", range(4))
def test_whatever_order_the_rows_come_in(tmp_path: Path, seed: int) -> None:
    spec, truth, rows = marked(tmp_path / "r.rrd")
    rng = np.random.default_rng(seed)
    rows[1][:, -1] = rng.integers(0, 2, 100)
    with Recording(spec) as recording:
        for k in rng.permutation(np.arange(0, 100, 5)):
            recording.estimates(1, k, rows[1][k : k + 8][: 100 - k])  # some rows twice
        recording.truth(0, truth)
        recording.fill(truth, rows)
    assert lane(tmp_path / "r.rrd", 1, 100) == words(rows[1][:, -1])
    assert lane(tmp_path / "r.rrd", 2, 100) == words(rows[2][:, -1])


def test_a_gap_is_a_gap_in_lines_and_lanes_and_the_return_is_seen(tmp_path: Path) -> None:
    spec, truth, rows = marked(tmp_path / "r.rrd")
    rows[2][50:60] = np.nan
    with Recording(spec) as recording:
        recording.liveness(2, "up", 0)
        recording.truth(0, truth)
        recording.estimates(1, 0, rows[1])
        recording.estimates(2, 0, rows[2][:50])
        recording.liveness(2, "down", 50)
        recording.liveness(2, "up", 60)
        recording.estimates(2, 60, rows[2][60:80])
        recording.fill(truth, {2: rows[2][:90]})
    path = tmp_path / "r.rrd"
    k, values = read_series(path, "/error/node_2")
    assert k.tolist() == [*range(51), *range(60, 90)]
    assert k[np.isnan(values)].tolist() == [50]
    expected = words(rows[2][:, -1])
    expected[50:60], expected[90:] = ["no estimate"] * 10, ["no estimate"] * 10
    assert lane(path, 2, 100) == expected
    assert read_texts(path, "/alive/node_2", COLUMN) == [(0, "up"), (50, "down"), (60, "up")]


@pytest.mark.parametrize("flushes", [0, 1, 4])
def test_a_gap_is_where_the_rows_say_though_the_news_of_it_came_at_another_time(tmp_path: Path, flushes: int) -> None:
    """A fast run: the recorder hears of death and return between two batches of rows, and of the start too late."""
    spec, truth, rows = marked(tmp_path / "r.rrd")
    with Recording(spec) as recording:
        recording.liveness(1, "up", 0)
        recording.truth(0, truth)
        recording.estimates(1, 0, rows[1])
        recording.estimates(2, 0, rows[2][:20])
        recording.liveness(2, "up", 19)
        recording.estimates(2, 20, rows[2][20:50])
        recording.liveness(2, "down", 19)
        for _ in range(flushes):
            recording.flush()  # two of them without news of rows: it is believed
        recording.liveness(2, "up", 49)
        recording.flush()
        recording.estimates(2, 60, rows[2][60:80])
        recording.flush()
        recording.liveness(2, "down", 79)
        recording.liveness(2, "up", 79)
        recording.estimates(2, 90, rows[2][90:])
    path = tmp_path / "r.rrd"
    states = [(0, "up"), (50, "down"), (60, "up"), (80, "down"), (90, "up")]
    assert read_texts(path, "/alive/node_2", COLUMN) == states
    told = [(k, text) for k, text in read_texts(path, "/events", "TextLog:text") if "node-2" in text]
    assert told == [
        (50, "node-2 is down"),
        (60, "node-2 is up again"),
        (80, "node-2 is down"),
        (90, "node-2 is up again"),
    ]


def lossy_trace() -> Trace:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((50, 3))
    xhat = x + 0.1 * rng.standard_normal((3, 50, 3))
    flags = np.zeros((3, 50), dtype=bool)
    flags[0, 10:20] = flags[2, 33] = flags[1, 40:] = True
    xhat[1, 20:30], flags[1, 20:30] = np.nan, False
    what, vhat = rng.standard_normal((3, 50, 2)), {3: rng.standard_normal((50, 1))}
    return Trace(np.arange(50) * 0.1, x, np.array([1, 2, 3]), xhat, what, vhat, flagged=flags)


def test_a_finished_trace_is_recorded_with_marks_gap_and_return(tmp_path: Path) -> None:
    trace, path = lossy_trace(), tmp_path / "r.rrd"
    record_trace(path, make_scenario(), trace)
    assert trace.flagged is not None
    for at, i in enumerate((1, 2, 3)):
        expected = words(trace.flagged[at])
        if i == 2:
            expected[20:30] = ["no estimate"] * 10
        assert lane(path, i, 50) == expected
    assert read_texts(path, "/alive/node_2", COLUMN) == [(0, "up"), (20, "down"), (30, "up")]
    assert read_series(path, "/noise/node_3/v1")[1].tobytes() == trace.vhat[3].tobytes()
    told = [text for _, text in read_texts(path, "/events", "TextLog:text")]
    assert "node-2 is down" in told
    assert "node-2 is up again" in told
    for edge in ("1_2", "2_3"):
        chunks = RrdReader(path).stream().filter(content=f"/mesh/edges/{edge}", has_timeline="step")
        batches = [chunk.to_record_batch() for chunk in chunks]
        names = {colour: state for state, colour in STATES.items()}
        changes = [
            (k, names[colours[0]])
            for batch in batches
            for k, colours in zip(
                batch.column("step").cast(pa.int64()).to_pylist(),
                batch.column("Arrows2D:colors").to_pylist(),
                strict=True,
            )
        ]
        assert changes[-2:] == [(20, "down"), (30, "up")], edge


def test_the_trace_file_keeps_the_marks(tmp_path: Path) -> None:
    trace = lossy_trace()
    write_trace(tmp_path / "trace.npz", trace)
    found = read_trace(tmp_path / "trace.npz")
    assert found.flagged is not None
    assert found.flagged.dtype == bool
    assert np.array_equal(found.flagged, trace.flagged)
    assert [np.flatnonzero(row).tolist() for row in found.lost] == [[], list(range(20, 30)), []]
    np.savez(tmp_path / "wrong.npz", allow_pickle=False, **trace.arrays() | {"flagged": np.zeros((2, 50), dtype=bool)})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"flagged \(2, 50\)"):
        read_trace(tmp_path / "wrong.npz")


def test_the_figures_shade_the_flagged_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    drawn: dict[str, Any] = {}
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **_: drawn.__setitem__(Path(path).name, self))
    trace = lossy_trace()
    assert trace.flagged is not None
    figures(tmp_path, SimpleNamespace(name="synthetic"), trace)  # type: ignore[arg-type]
    for axes, spans in zip(drawn["errors.png"].axes, ([(1.0, 2.0)], [(4.0, 4.9)], [(3.3, 3.4)]), strict=False):
        (shade,) = axes.collections
        assert to_hex(shade.get_facecolor()[0]) == SHADE
        found = [tuple(path.get_extents().intervalx) for path in shade.get_paths()]
        assert found == [pytest.approx(span) for span in spans]
    for name in ("error_norms.png", "estimates.png", "unknown_inputs.png"):
        broad = [line for line in drawn[name].axes[0].get_lines() if line.get_label() == "flagged"]
        there = [np.flatnonzero(np.isfinite(line.get_ydata())).tolist() for line in broad]
        assert there == [list(range(10, 21)), list(range(40, 50)), [33, 34]], name
    for name, figure in drawn.items():
        texts = [text.get_text() for text in figure.legends[0].get_texts()]
        assert texts.count("flagged") == (name != "states.png"), name
        assert len(set(texts)) == len(texts)
