"""The rounds of a watched step stand in the recording as they were, whoever made it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic import entities, make_rows, make_spec, read_series

from duio_mesh import launcher, load_scenario, simulate, synthesise
from duio_mesh.arrays import Array
from duio_mesh.dynamics import Plant
from duio_mesh.errors import DesignError
from duio_mesh.observers import make_observer
from duio_mesh.observers.watch import RoundWatch
from duio_mesh.report.recording import Recording
from duio_mesh.synthesis.design import Design
from tests.conftest import TOPOLOGIES

STEP = 11


def watched_ring(topology: str = "admm_ring.yaml", **options: object) -> Design:
    given = {"run.steps": 20, "observer.watch_step": STEP} | options
    return synthesise(load_scenario(TOPOLOGIES / topology, **given))


def by_hand(design: Design, step: int) -> dict[int, Array]:
    """Node -> rows [round, residual, disagreement] of the step, from the messages of the oracle's observers."""
    plant, observers = Plant(design.plant), {i: make_observer(s) for i, s in design.nodes.items()}
    C = {sensor.id: sensor.C for sensor in design.plant.sensors}
    follows = {i: np.zeros(s.matrices["Abar"].shape[0]) for i, s in design.nodes.items()}
    found: dict[int, list[tuple[float, float, float]]] = {i: [] for i in observers}
    for k in range(step + 1):
        data, xi = plant.sample(), {}
        for i, spec in design.nodes.items():
            y, u, m = data[i][: spec.p], data[i][spec.p :], spec.matrices
            assert len(y) == len(C[i])
            observers[i].sample(y, u)
            xi[i] = np.concatenate([follows[i], y])
            follows[i] = m["Abar"] @ follows[i] - m["PL"] @ y + m["PB"] @ u
        plant.advance()
        for r in range(observers[1].rounds):
            x = {i: o.message(r).copy() for i, o in observers.items()}
            for i, spec in design.nodes.items():
                if k == step:
                    residual = np.linalg.norm(spec.matrices["T"] @ x[i] - xi[i])
                    found[i].append((r, residual, max(np.linalg.norm(x[i] - x[j]) for j in spec.hears)))
                observers[i].exchange(r, {j: x[j] for j in spec.hears})
    return {i: np.array(rows) for i, rows in found.items()}


def check(path: Path, expected: dict[int, Array]) -> None:
    for i, rows in expected.items():
        for at, kind in ((1, "residual"), (2, "disagreement")):
            r, values = read_series(path, f"/rounds/{kind}/node_{i}", "round")
            assert r.tolist() == rows[:, 0].tolist()
            np.testing.assert_allclose(10**values, rows[:, at], rtol=1e-6, atol=1e-14)
            assert set(read_series(path, f"/rounds/{kind}/node_{i}", "step")[0]) == {STEP}
            t = read_series(path, f"/rounds/{kind}/node_{i}", "sim_time")[0] / 1e9
            assert t[0] == STEP
            assert STEP < t[-1] < STEP + 1  # one second a step: the rounds are spread over it
            assert (np.diff(t) > 0).all()


def test_in_process(tmp_path: Path) -> None:
    design = watched_ring()
    expected = by_hand(design, STEP)
    assert expected[1].shape == (59, 3)
    launcher.run_in_process(design, tmp_path / "oracle")
    check(tmp_path / "oracle" / "recording.rrd", expected)


@pytest.mark.mesh
def test_over_zenoh(tmp_path: Path) -> None:
    design = watched_ring()
    result = launcher.run(design, tmp_path / "mesh")
    check(tmp_path / "mesh" / "recording.rrd", by_hand(design, STEP))
    oracle = simulate(design)
    for i, rows in oracle.rounds.items():
        assert result.trace.rounds[i].tobytes() == rows.tobytes()


def test_the_block_of_a_batch_and_a_set_up_that_comes_first() -> None:
    """The two rounds of the block in which the step is; those of the set-up are not counted."""
    for batch, step in ((1, STEP), (4, STEP), (7, 0), (64, 19)):
        design = watched_ring("finite_time_ring.yaml", **{"run.batch": batch, "observer.watch_step": step})
        rounds = simulate(design).rounds
        assert sorted(rounds) == [1, 2, 3, 4]
        for rows in rounds.values():
            assert rows[:, 0].tolist() == [0, 1]
            assert rows[1, 2] > 0


def test_nothing_is_watched_unless_asked(tmp_path: Path) -> None:
    design = watched_ring(**{"observer.watch_step": None})
    assert simulate(design).rounds == {}
    launcher.run_in_process(design, tmp_path / "run")
    assert not [path for path in entities(tmp_path / "run" / "recording.rrd") if path.startswith("/rounds")]


def test_many_rounds_are_thinned_and_keep_their_ends() -> None:
    watch = RoundWatch(29_999)
    for r in range(29_999):
        watch(r, 1.0, 2.0)
    rows = watch.take()
    assert len(rows) <= 1001
    assert rows[0].tolist() == [0, 1, 2]
    assert rows[-1, 0] == 29_998
    assert watch.take().shape == (0, 3)


def test_a_step_that_does_not_exist_is_refused() -> None:
    with pytest.raises(DesignError, match=r"observer.watch_step.*no step 20 in a run of 20"):
        watched_ring(**{"observer.watch_step": 20})


def test_only_a_nodes_first_rows_count_and_wrong_ones_are_refused(tmp_path: Path) -> None:
    spec = make_spec(tmp_path / "r.rrd", watch_step=3)
    truth, rows = make_rows(spec)
    with Recording(spec) as recording:
        recording.fill(truth, rows)
        recording.rounds(1, np.array([[0, 100.0, 0.0], [1, 10.0, 1e-3]]))
        recording.rounds(1, np.array([[0, 1.0, 1.0]]))
        recording.rounds(2, np.zeros((0, 3)))
        with pytest.raises(ValueError, match=r"\(1, 2\)"):
            recording.rounds(1, np.zeros((1, 2)))
    assert read_series(tmp_path / "r.rrd", "/rounds/residual/node_1", "round")[1].tolist() == [2, 1]
    assert read_series(tmp_path / "r.rrd", "/rounds/disagreement/node_1", "round")[1].tolist() == [-16, -3]
    assert len(read_series(tmp_path / "r.rrd", "/rounds/residual/node_2", "round")[0]) == 0
