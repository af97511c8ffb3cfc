"""Many nodes: what a person sees of them, and limits of the machine that are said before anything starts."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from duio_mesh.console import FEW, MANY, chosen
from duio_mesh.errors import RunError
from duio_mesh.limits import check_files
from duio_mesh.report.pairing import Errors
from duio_mesh.report.recording import Recording
from duio_mesh.report.worst import Worst
from duio_mesh.spec import RecorderSpec


def nodes(count: int) -> dict[str, dict[str, float | None]]:
    """Errors that grow with the id, but for node 5, which has none."""
    return {str(i): {"rms": None if i == 5 else float(i)} for i in range(1, count + 1)}


def test_the_table_of_few_nodes_has_all_in_their_order() -> None:
    assert [name for name, _ in chosen(nodes(MANY), "rms")] == [str(i) for i in range(1, MANY + 1)]


def test_the_table_of_many_nodes_has_the_worst_the_median_and_the_best() -> None:
    names = [name for name, _ in chosen(nodes(128), "rms")]
    assert names[:FEW] == ["5", "128", "127", "126", "125", "124", "123", "122"]
    assert names[FEW:] == ["65 (median of 128)", "1 (best)"]


def test_too_few_open_files_are_said_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (100, 150))
    check_files(50)
    with pytest.raises(RunError, match=r"100 are allowed: ulimit -n 112$"):
        check_files(64)
    with pytest.raises(RunError, match=r"needs a higher hard limit \(now 150"):
        check_files(128)


def test_the_worst_nodes_are_those_with_the_largest_errors_in_the_last_tenth() -> None:
    worst = Worst(range(1, 6), 100)
    for node, early, late in ((1, 9.0, 0.0), (2, 0.0, 2.0), (3, 0.0, np.nan), (4, 0.0, 1.0)):  # nothing came from 5
        worst.see(Errors(node, np.array([10, 89]), np.array([early, early])))
        worst.see(Errors(node, np.array([90, 99]), np.array([-1.0, late])))
    assert [worst.nodes(count) for count in (1, 2, 3, 4)] == [(5,), (3, 5), (2, 3, 5), (2, 3, 4, 5)]


def test_a_finished_recording_of_many_nodes_shows_the_worst(tmp_path: Path) -> None:
    count, steps = 20, 40
    ids = range(1, count + 1)
    arcs = tuple((i, i % count + 1) for i in ids)
    spec = RecorderSpec("many", 2, dict.fromkeys(ids, 2), arcs, 1.0, steps, str(tmp_path / "r.rrd"), False, "", "", {})
    with Recording(spec, rates=False) as recording:
        recording.truth(0, np.zeros((steps, 2)))
        for i in ids:
            recording.estimates(i, 0, np.full((steps, 2), float(i)))
    reader = RrdReader(tmp_path / "r.rrd")
    first, last = sorted(  # they come in no particular order
        (
            "".join(str(column) for chunk in reader.stream(store=layout) for column in chunk.to_record_batch().columns)
            for layout in reader.blueprints()
        ),
        key=lambda text: "worst" in text,
    )
    assert "worst" not in first
    assert "The 16 worst nodes" in last
    tabs = {i for i in ids if f'"Node {i}"' in last}
    assert tabs == set(range(5, 21))
