"""Without a truth: the verdict, the recording and the figures say how far the nodes agree, and nothing of errors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duio_mesh.arrays import Array
from duio_mesh.report.figures import figures
from duio_mesh.report.metrics import metrics
from duio_mesh.report.pairing import Middle
from duio_mesh.report.record_trace import record_trace
from duio_mesh.report.trace_file import read_trace, write_trace
from duio_mesh.trace import Trace
from tests.external.feeding import IDS, base, driven, rooms
from tests.report.synthetic import read_series, read_texts


def trace_of(samples: dict[int, Array]) -> Trace:
    xhat = driven(base(), samples)
    K = xhat.shape[1]
    x = np.full((K, 9), math.nan)
    return Trace(t=60.0 * np.arange(K), x=x, node_ids=np.array(IDS), xhat=xhat, samples=samples)


def test_a_sensor_that_is_wrong_is_seen_and_who_it_is() -> None:
    good = metrics(trace_of(rooms()), base().scenario, {"failure": ""})
    assert (good["verdict"], good["agree"], good["converged"]) == ("the nodes agree", True, None)
    samples = {i: table.copy() for i, table in rooms().items()}
    samples[2][:, 1] += 4.0  # node 2's thermometer in room 6 shows four degrees too much
    bad = metrics(trace_of(samples), base().scenario, {"failure": ""})
    assert (bad["verdict"], bad["agree"], bad["converged"]) == ("the nodes do not agree", False, None)
    residual = {i: node["residual"] for i, node in bad["nodes"].items()}
    assert max(residual, key=residual.__getitem__) == "2"
    assert residual["2"] > 2.0


@pytest.mark.parametrize("counts", [{"failure": "lost"}, {}])
def test_an_incomplete_run_is_not_judged(counts: dict[str, Any]) -> None:
    trace = trace_of({i: table[:30] for i, table in rooms().items()})
    if not counts:
        trace.xhat[2, 20:] = math.nan
    found = metrics(trace, base().scenario, counts)
    assert (found["verdict"], found["agree"], found["converged"]) == ("incomplete", False, None)


def test_the_samples_are_kept_in_the_trace(tmp_path: Path) -> None:
    trace = trace_of({i: table[:5] for i, table in rooms().items()})
    write_trace(tmp_path / "trace.npz", trace)
    again = read_trace(tmp_path / "trace.npz")
    assert {i: table.tobytes() for i, table in again.samples.items()} == {
        i: table.tobytes() for i, table in trace.samples.items()
    }


def test_distances_from_the_mean_in_any_order_of_arrival() -> None:
    rng = np.random.default_rng(7)
    rows = rng.standard_normal((4, 50, 3))
    batches = [(at, k, min(k + 7, 50)) for at in range(4) for k in range(0, 50, 7)]
    middle, found = Middle(3, range(4), 50), np.full((4, 50), math.nan)
    for n in rng.permutation(len(batches)):
        at, k, end = batches[n]
        for errors in middle.together(at, k, rows[at, k:end]):
            found[errors.node, errors.steps] = errors.log10
    expected = np.log10(np.linalg.norm(rows - rows.sum(axis=0) / 4, axis=2))
    assert np.allclose(found, expected, rtol=0, atol=1e-13)


def test_the_recording_and_the_figures_speak_of_no_error(tmp_path: Path) -> None:
    trace = trace_of(rooms())
    record_trace(tmp_path / "recording.rrd", base().scenario, trace)
    said = [text for _, text in read_texts(tmp_path / "recording.rrd", "/events", "TextLog:text")]
    assert said[-1].startswith("complete")
    for at, i in enumerate(IDS):
        steps, values = read_series(tmp_path / "recording.rrd", f"/error/node_{i}")
        apart = np.linalg.norm(trace.xhat[at] - trace.xhat.mean(axis=0), axis=1)
        assert steps.tolist() == list(range(101))
        assert values == pytest.approx(np.log10(apart), abs=1e-12)
    names = {path.name for path in figures(tmp_path, base().scenario, trace)}
    assert names == {"estimates.png"}
