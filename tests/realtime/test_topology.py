"""What ``timing`` says once it is read, and what it makes of a design."""

from __future__ import annotations

from pathlib import Path

import pytest

import duio_mesh
from duio_mesh.report.timeliness import in_words, untimely
from duio_mesh.scenario.model import LOCKSTEP, Timing
from duio_mesh.scenario.problems import Problems
from duio_mesh.scenario.timing import read_timing
from tests.conftest import TOPOLOGIES
from tests.scenario.broken import VALID
from tests.scenario.stand_in import load


@pytest.fixture
def topology(tmp_path: Path) -> Path:
    (tmp_path / "t.yaml").write_text(VALID)
    return tmp_path / "t.yaml"


def test_timing_is_read_in_seconds(topology: Path) -> None:
    assert load(topology).timing == load(topology, "timing=lockstep").timing == LOCKSTEP
    assert load(topology, "timing=realtime").timing == Timing("realtime", 1.0, 0.5)  # the plant's own period
    assert load(topology, "timing={mode: realtime, tick: 0.02}").timing == Timing("realtime", 0.02, 0.01)
    assert load(topology, "timing={mode: realtime, tick: 0.02, wait: 0.9}").timing.wait == pytest.approx(0.018)


def test_nobody_comes_back_in_real_time() -> None:
    for policy, refused in (("restart", True), ("degrade", False), ("stop", False)):
        problems = Problems()
        read_timing({"timing": {"mode": "realtime", "tick": 0.1}}, None, {"on_node_loss": policy}, problems)
        assert bool(problems) == refused


def test_a_design_for_the_clock_has_the_same_gains_and_knows_what_to_do_without_a_neighbour() -> None:
    file, timing = TOPOLOGIES / "ring.yaml", {"mode": "realtime", "tick": 2.0}
    still = duio_mesh.synthesise(duio_mesh.load_scenario(file))
    timed = duio_mesh.synthesise(duio_mesh.load_scenario(file, timing=timing))
    assert (timed.plant.tick, timed.plant.wait, timed.plant.block, timed.plant.deadline) == (2.0, 1.0, 1, 7.0)
    for i, spec in timed.nodes.items():
        assert (spec.without, spec.tick, spec.wait, spec.block, spec.credit) == ("skip", 2.0, 1.0, 1, 1)
        assert still.nodes[i].without == ""
        for name, M in spec.matrices.items():
            assert M.tobytes() == still.nodes[i].matrices[name].tobytes()


def test_how_long_it_will_take_is_said_beforehand() -> None:
    assert in_words(LOCKSTEP, 100, processes=True) == ""
    assert (
        in_words(Timing("realtime", 0.02, 0.01), 100, processes=True)
        == "realtime: 100 ticks of 0.02 s, about 2 s in all"
    )
    assert in_words(Timing("realtime", 60.0, 30.0), 101, processes=True).endswith("about 101 min in all")
    assert in_words(Timing("realtime", 60.0, 30.0), 480, processes=True).endswith("8 h in all")


def test_only_what_is_noticeable_is_warned_of() -> None:
    fine = {"on_time": 995, "late": 4, "missing": 1, "overruns": 5}
    poor = {"on_time": 900, "late": 60, "missing": 40, "overruns": 50}
    worse = poor | {"on_time": 300, "late": 660}
    plant = {"late_ticks": 3, "worst_lateness": 0.019, "behind": []}
    timing = {"tick": 0.02, "plant": plant, "nodes": {"1": fine, "2": poor, "3": worse}}
    assert untimely(timing, 1000) == [
        "node-3 went on without 70% of its neighbours' messages: 660 came late, 40 not at all",
        "node-2 went on without 10% of its neighbours' messages: 60 came late, 40 not at all",
        "node-2 needed more than a tick for 50 of 1000 steps, and so did 1 more",
    ]
    late = plant | {"late_ticks": 30, "worst_lateness": 1.2345, "behind": ["node-3 (at step 5)"]}
    assert untimely(timing | {"plant": late, "nodes": {"1": fine}}, 1000) == [
        "plant: 30 of 1000 ticks began late, by 1.23 s at worst; node-3 (at step 5) kept it waiting"
    ]
