"""What is fed to a recording is what stands in its file: bit for bit, in any order, with its gaps named."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from synthetic import entities, make_rows, make_spec, read_series, read_texts

from duio_mesh.arrays import Array
from duio_mesh.report import entities as budget
from duio_mesh.report import pairing
from duio_mesh.report import recording as module
from duio_mesh.report.recording import Recording
from duio_mesh.spec import RecorderSpec, write_spec


def feed(recording: Recording, truth: Array, rows: dict[int, Array], length: int = 10) -> None:
    """Everything, in order, in batches."""
    for k in range(0, len(truth), length):
        recording.truth(k, truth[k : k + length])
        for i in rows:
            recording.estimates(i, k, rows[i][k : k + length])
        recording.flush()


def check_complete(spec: RecorderSpec, truth: Array, rows: dict[int, Array]) -> None:
    """Every state, estimate and error norm of every step stands in the file once."""
    path, steps = Path(spec.recording), list(range(spec.steps))
    for c in range(spec.n):
        k, values = read_series(path, f"/state/x{c + 1}/actual")
        assert k.tolist() == steps
        assert values.tobytes() == np.ascontiguousarray(truth[:, c]).tobytes()
        for i in rows:
            k, values = read_series(path, f"/state/x{c + 1}/node_{i}")
            assert k.tolist() == steps
            assert values.tobytes() == np.ascontiguousarray(rows[i][:, c]).tobytes()
    for i in rows:
        k, values = read_series(path, f"/error/node_{i}")
        assert k.tolist() == steps
        np.testing.assert_allclose(10**values, np.linalg.norm(rows[i][:, : spec.n] - truth, axis=1), rtol=1e-12)


def test_a_whole_run_comes_back_on_both_timelines(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd")
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        feed(recording, truth, rows)
        assert recording.missing() == {}
        assert recording.url is None
    check_complete(spec, truth, rows)
    t, values = read_series(tmp_path / "r.rrd", "/state/x1/actual", "sim_time")
    assert t.tolist() == [k * 60 * 10**9 for k in range(101)]
    assert values.tobytes() == np.ascontiguousarray(truth[:, 0]).tobytes()
    assert read_texts(tmp_path / "r.rrd", "/events", "TextLog:text")[-1] == (
        100,
        "complete: every step of every node is here",
    )


@pytest.mark.parametrize("seed", range(3))
def test_batches_in_any_order_and_twice(tmp_path: Path, seed: int) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=3)
    truth, rows = make_rows(spec)
    rng = np.random.default_rng(seed)
    batches = []
    for source in (0, 1, 2):
        cuts = sorted({0, 101, *rng.integers(1, 101, 12).tolist()})
        batches += [(source, a, b) for a, b in itertools.pairwise(cuts)]
        batches += [(source, a, min(101, a + 20)) for a in rng.integers(0, 100, 5).tolist()]
    with Recording(spec) as recording:
        for at in rng.permutation(len(batches)):
            source, a, b = batches[at]
            if source:
                recording.estimates(source, a, rows[source][a:b])
            else:
                recording.truth(a, truth[a:b])
            recording.flush()
        assert recording.missing() == {}
    check_complete(spec, truth, rows)


def test_the_caller_may_reuse_its_arrays(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=1, n=2, steps=8)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        own, other = np.empty((1, 2)), np.empty((1, 2))
        for k in range(8):
            own[0], other[0] = truth[k], rows[1][k]
            recording.truth(k, own)
            recording.estimates(1, k, other)
    check_complete(spec, truth, rows)


def test_gaps_are_named_and_break_the_lines(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, steps=50)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        recording.truth(0, truth[:40])
        recording.estimates(1, 0, rows[1])
        recording.estimates(2, 0, rows[2][:10])
        recording.estimates(2, 20, rows[2][20:30])
        assert recording.missing() == {None: [(40, 50)], 1: [(40, 50)], 2: [(10, 20), (30, 50)]}
    k, values = read_series(tmp_path / "r.rrd", "/error/node_2")
    assert k.tolist() == [*range(11), *range(20, 30)]
    assert np.isnan(values).tolist() == [at == 10 for at in k]
    k, values = read_series(tmp_path / "r.rrd", "/state/x1/node_2")
    assert k[np.isnan(values)].tolist() == [10]
    texts = [text for _, text in read_texts(tmp_path / "r.rrd", "/events", "TextLog:text")]
    assert "not in the recording: node 2, steps 10 to 19, 30 to 49" in texts
    assert not any("complete" in text for text in texts)


def test_gaps_are_filled_from_files_and_what_nobody_wrote_stays_missing(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=3, n=2, steps=60)
    truth, rows = make_rows(spec)
    lost = rows[3].copy()
    lost[45:] = np.nan
    with Recording(spec) as recording:
        recording.estimates(1, 0, rows[1][:30])  # before its truth
        recording.truth(5, truth[5:20])
        recording.estimates(2, 10, rows[2][10:20])
        known = truth.copy()
        known[:3] = np.nan
        recording.fill(known, {1: rows[1], 2: rows[2][:50], 3: lost})
        assert recording.missing() == {
            None: [(0, 3)],
            1: [(0, 3)],
            2: [(0, 3), (50, 60)],
            3: [(0, 3), (45, 60)],
        }
    for i, steps in ((1, 60), (2, 50), (3, 45)):
        k, values = read_series(tmp_path / "r.rrd", f"/error/node_{i}")
        assert k.tolist() == list(range(3, steps))
        np.testing.assert_allclose(10**values, np.linalg.norm(rows[i] - truth, axis=1)[3:steps])
        assert read_series(tmp_path / "r.rrd", f"/state/x2/node_{i}")[0].tolist() == list(range(steps))


def test_memory_is_bounded_and_filling_finds_what_fell_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairing, "MEMORY", 1)
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, steps=1000)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        assert recording._pairing.window == 256
        recording.truth(0, truth)  # more than can wait: the first steps are forgotten
        recording.estimates(1, 0, rows[1])
        recording.estimates(2, 900, rows[2][900:])
        assert recording.missing() == {1: [(0, 744)], 2: [(0, 900)]}
        recording.fill(truth, rows)
        assert recording.missing() == {}
    check_complete(spec, truth, rows)


def test_a_long_run_is_thinned_and_keeps_its_spikes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "ERROR_ROWS", 400)
    monkeypatch.setattr(budget, "STATE_VALUES", 900)
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, steps=2005)
    truth, rows = make_rows(spec, noise=0.01)
    rows[1][1234] += 1e6
    rows[2][777] = truth[777]
    with Recording(spec) as recording:
        feed(recording, truth, rows, length=7)
    own = {i: np.log10(np.maximum(np.linalg.norm(rows[i] - truth, axis=1), 1e-16)) for i in rows}
    for i in rows:
        k, values = read_series(tmp_path / "r.rrd", f"/error/node_{i}")
        assert 150 <= len(k) <= 200
        np.testing.assert_allclose(values, own[i][k], atol=1e-12)
        for first in range(0, 2005, 21):
            inside = values[(k >= first) & (k < first + 21)]
            assert inside.max() == pytest.approx(own[i][first : first + 21].max())
            assert inside.min() == pytest.approx(own[i][first : first + 21].min())
    k, values = read_series(tmp_path / "r.rrd", "/state/x1/node_1")
    assert k.tolist() == [*range(0, 2005, 14), 2004]
    assert values.tobytes() == rows[1][k, 0].tobytes()


def test_a_wide_run_shows_some_states_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(budget, "SERIES", 20)
    spec = make_spec(tmp_path / "r.rrd", nodes=4, n=12, steps=5)
    with Recording(spec) as recording:
        feed(recording, *make_rows(spec))
    assert sorted(p for p in entities(tmp_path / "r.rrd") if p.endswith("/actual")) == [
        f"/state/x{c:02d}/actual" for c in (1, 5, 8, 12)
    ]
    chunk = next(iter(RrdReader(tmp_path / "r.rrd").stream().filter(content="/description")))
    text = chunk.to_record_batch().column("TextDocument:text").to_pylist()[0][0]
    assert "States and estimates of 4 of the 12 states: every step." in text
    assert text.startswith("# Synthetic ring")


def test_sends_are_few_however_often_it_is_flushed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SENDS", 20)
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, steps=4000)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        feed(recording, truth, rows, length=5)
    check_complete(spec, truth, rows)
    series = {path: n for path, n in entities(tmp_path / "r.rrd").items() if path.startswith(("/error", "/state"))}
    assert len(series) == 2 + 2 * 3
    assert max(series.values()) <= 20 + 2  # and the static style, and the rest at the end


def test_what_is_reconstructed_has_its_own_place(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, extra=3, unknown_inputs=1, steps=20)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        feed(recording, truth, rows)
    for i in (1, 2):
        for column, path in (
            (2, f"/unknown_input/w1/node_{i}"),
            (3, f"/noise/node_{i}/v1"),
            (4, f"/noise/node_{i}/v2"),
        ):
            assert read_series(tmp_path / "r.rrd", path)[1].tobytes() == rows[i][:, column].tobytes()


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # it is read while it is written
def test_processes_and_edges(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=3, n=2, steps=30)
    truth, rows = make_rows(spec)
    path = tmp_path / "r.rrd"
    with Recording(spec) as recording:
        for who in ("plant", 1, "node-2", 3):
            recording.liveness(who, "up", 0)
        recording.truth(0, truth)
        for i, k in ((1, 30), (2, 12), (3, 27)):
            recording.estimates(i, 0, rows[i][:k])
        recording.liveness("node-2", "late", 8)
        recording.liveness("node-2", "late", 9)
        recording.liveness(2, "down", 12)
        recording.flush()
        assert len(read_texts(path, "/alive/node_2", "StateChange:state")) == 2, "too early to tell"
        recording.flush()
        assert len(read_texts(path, "/alive/node_2", "StateChange:state")) == 3
        recording.liveness(2, "up", 15)
        recording.edge(1, 3, "late", 17)
        recording.edge(1, 3, "up", 19)
        for who in ("plant", "node-1", "node-3"):
            recording.liveness(who, "down", 28)  # before the news of their last rows
        recording.flush()
        recording.estimates(3, 27, rows[3][27:29])
        recording.flush()
        recording.estimates(3, 29, rows[3][29:])
        recording.flush()
        recording.flush()
        with pytest.raises(KeyError, match="node 1 does not tell node 7"):
            recording.edge(1, 7, "late", 0)
    assert read_texts(path, "/alive/node_2", "StateChange:state") == [(0, "up"), (8, "late"), (12, "down"), (15, "up")]
    for who in ("plant", "node_1", "node_3"):
        assert read_texts(path, f"/alive/{who}", "StateChange:state") == [(0, "up")]
    told = [text for _, text in read_texts(path, "/events", "TextLog:text")]
    assert told[1:-1] == [
        "node-2 is late",
        "node-2 is down",
        "node-2 is up again",
        "edge 1 to 3 is late",
        "edge 1 to 3 is up again",
    ]
    assert _colours(path, "/mesh/edges/1_2", "LineStrips2D") == [
        (0, "unknown"),
        (0, "up"),
        (8, "late"),
        (12, "down"),
        (15, "up"),
    ]
    assert _colours(path, "/mesh/edges/1_3", "LineStrips2D") == [
        (0, "unknown"),
        (0, "up"),
        (17, "late"),
        (19, "up"),
    ]
    assert _colours(path, "/mesh/alive/node_3", "Points2D") == [(0, "unknown"), (0, "up")]


def _colours(path: Path, entity: str, kind: str) -> list[tuple[int, str]]:
    """(step, state) of every change of colour, in the order of the file."""
    names = {colour: state for state, colour in budget.STATES.items()}
    found = []
    for chunk in RrdReader(path).stream().filter(content=entity, has_timeline="step", components=f"{kind}:colors"):
        batch = chunk.to_record_batch()
        colours = batch.column(f"{kind}:colors").to_pylist()
        found += [(k, names[c[0]]) for k, c in zip(batch.column("step").to_pylist(), colours, strict=True)]
    return sorted(found, key=lambda change: change[0])


def test_a_process_that_ends_early_is_down_though_nobody_flushes(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=1, n=2, steps=30)
    with Recording(spec) as recording:
        recording.liveness(1, "up", 0)
        recording.liveness(1, "down", 9)
    assert read_texts(tmp_path / "r.rrd", "/alive/node_1", "StateChange:state") == [(0, "up"), (9, "down")]


def test_rates(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=2, steps=30)
    with Recording(spec) as recording:
        recording.rates(10, {"plant": 512.5, "node-2": 510.0})
        recording.rates(20, {"plant": 500.0})
    k, values = read_series(tmp_path / "r.rrd", "/rates/plant")
    assert (k.tolist(), values.tolist()) == ([10, 20], [512.5, 500.0])
    assert read_series(tmp_path / "r.rrd", "/rates/node_2")[1].tolist() == [510.0]


def test_wrong_rows_are_refused(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=3, steps=10)
    with Recording(spec) as recording:
        with pytest.raises(ValueError, match=r"the truth: rows of shape \(4, 2\) instead of \(m, 3\)"):
            recording.truth(0, np.zeros((4, 2)))
        with pytest.raises(ValueError, match="node 2: steps 8 to 11 of a run of 10"):
            recording.estimates(2, 8, np.zeros((4, 3)))
        with pytest.raises(KeyError):
            recording.estimates(5, 0, np.zeros((4, 3)))


def test_where_nothing_can_be_recorded_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match="cannot record to"):
        Recording(make_spec(tmp_path / "nowhere" / "r.rrd"))
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(ValueError, match="RERUN=off"):
        Recording(make_spec(tmp_path / "r.rrd"))


def test_the_layout_is_in_the_file_and_shows_what_is_there(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", extra=2, unknown_inputs=1, steps=20)
    with Recording(spec) as recording:
        feed(recording, *make_rows(spec))
        recording.rates(10, {"plant": 1.0})
        recording.liveness("plant", "up", 0)
    reader = RrdReader(tmp_path / "r.rrd")
    (store,) = reader.blueprints()
    assert store.application_id == reader.recordings()[0].application_id == "duio_mesh synthetic_ring"
    names, queries, origins = set[str](), set[str](), set[str]()
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        for component, into in (
            ("ContainerBlueprint:display_name", names),
            ("ViewBlueprint:display_name", names),
            ("ViewContents:query", queries),
            ("ViewBlueprint:space_origin", origins),
        ):
            if component in batch.schema.names:
                into |= {
                    line for row in batch.column(component).to_pylist() for text in row for line in text.split("\n")
                }
    assert {"Overview", "Estimates", "All nodes", "Node 4", "Reconstruction", "Run", "x9"} <= names
    assert len(queries) > 40
    assert {"/alive", "/mesh", "/events"} <= origins
    there = set(entities(tmp_path / "r.rrd"))
    for query in queries - {"$origin/**"}:
        prefix = query.removeprefix("+ ").removesuffix("/**")
        assert any(path == prefix or path.startswith(prefix + "/") for path in there), f"{query} shows nothing"
    for origin in origins:
        assert any(path.startswith(origin) for path in there), f"{origin} is empty"


def test_every_recording_has_its_own_id(tmp_path: Path) -> None:
    ids = set()
    for name in ("a.rrd", "b.rrd"):
        Recording(make_spec(tmp_path / name, nodes=1, n=1, steps=1)).close()
        ids.add(RrdReader(tmp_path / name).recordings()[0].recording_id)
    assert len(ids) == 2


def test_closing_twice_is_closing_once(tmp_path: Path) -> None:
    recording = Recording(make_spec(tmp_path / "r.rrd", nodes=1, n=1, steps=1))
    recording.close()
    size = (tmp_path / "r.rrd").stat().st_size
    recording.close()
    assert (tmp_path / "r.rrd").stat().st_size == size


MEMORY = """
import sys
from pathlib import Path
import duio_mesh.recorder  # first, as in the process: its allocator is told then
import numpy as np
from duio_mesh.report.recording import Recording
from duio_mesh.spec import RecorderSpec, read_spec

def own():
    lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("Anonymous"))

spec = read_spec(Path(sys.argv[1]), RecorderSpec)
rows = np.zeros((500, spec.n))
with Recording(spec) as recording:
    for k in range(0, spec.steps, len(rows)):
        recording.truth(k, rows)
        for i in spec.sizes:
            recording.estimates(i, k, rows)
        recording.flush()
        if k >= spec.steps // 5:  # every series has been sent
            print(own())
"""


def test_a_long_recording_gives_back_what_a_send_has_taken(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", n=6, steps=100_000)
    path = tmp_path / "recorder.spec"
    write_spec(spec, path)
    done = subprocess.run([sys.executable, "-c", MEMORY, str(path)], capture_output=True, text=True, check=True)
    sizes = [float(line) for line in done.stdout.split()]
    assert len(sizes) == 160
    assert max(sizes) - min(sizes) < 2.0, sizes  # MB; 5 to 9 where it is kept for later
