"""Losses and marks in a trace: what metrics.json says of them, on errors whose answers can be worked out by hand."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from duio_mesh.report.metrics import metrics
from duio_mesh.report.recovery import WINDOW, loss_in_words, recovery
from duio_mesh.scenario.model import Convergence
from duio_mesh.trace import Trace

K, LEVEL = 200, 0.01


def make_trace(errors: NDArray[np.float64], *, flagged: Any = False, scale: float = 1.0) -> Trace:
    """``errors`` (N, K): every component of the state is wrong by so much, with alternating signs; NaN is no row."""
    x = scale * (3 + np.sin(np.arange(errors.shape[1] * 2, dtype=np.float64)).reshape(-1, 2))
    xhat = x + errors[:, :, None] * np.array([1.0, -1.0])
    flags = np.broadcast_to(np.asarray(flagged, dtype=bool), errors.shape).copy()
    return Trace(np.arange(errors.shape[1]) * 0.1, x, np.arange(1, len(errors) + 1), xhat, flagged=flags)


def steady(nodes: int = 3) -> NDArray[np.float64]:
    return np.full((nodes, K), LEVEL)


def scenario(rms_below: float = 1.0, steps: int = K) -> Any:
    run = SimpleNamespace(convergence=Convergence(rms_below, 0.5), steps=steps, seed=0)
    return SimpleNamespace(run=run, outside=None)


def test_an_error_that_halves_is_back_when_the_halving_says_so() -> None:
    """Back at 2 * LEVEL: 1.28 / 2^j <= 0.02 first at j = 6; the neighbour starts at 0.16: j = 3; node 3 saw nothing."""
    e = steady()
    e[1, 50:60] = np.nan
    j = np.arange(K - 60)
    e[1, 60:] = np.maximum(1.28 * 0.999999 / 2.0**j, LEVEL)
    e[0, 60:] = np.maximum(0.16 * 0.999999 / 2.0**j, LEVEL)
    (loss,) = recovery(make_trace(e))
    assert loss == {"node": 2, "lost": [50, 60], "returned": True, "steps": {"1": 3, "2": 6, "3": 0}}
    words = loss_in_words(loss)
    assert words.startswith("node 2 was away in steps 50 to 59; steps from the return until")
    assert words.endswith("node 1 after 3, node 2 after 6, node 3 at once")


def test_a_node_that_never_returns_has_no_steps_and_the_others_count_from_the_loss() -> None:
    e = steady()
    e[1, 50:] = np.nan
    e[0, 50:67] = 5 * LEVEL  # until somebody mends it
    e[2, 50:] = 5 * LEVEL  # for good
    (loss,) = recovery(make_trace(e))
    assert loss == {"node": 2, "lost": [50, K], "returned": False, "steps": {"1": 17, "2": None, "3": None}}
    assert loss_in_words(loss).endswith("node 1 after 17, node 3 never")


def test_twice_is_still_back_and_a_little_more_is_not() -> None:
    for factor, steps in ((2 - 1e-6, 0), (2 + 1e-6, None)):
        e = steady(1)
        e[0, 50:60] = np.nan
        e[0, 60:] = factor * LEVEL
        assert recovery(make_trace(e))[0]["steps"] == {"1": steps}


def test_an_error_that_passes_through_zero_is_not_back() -> None:
    """It swings between -1 and 1 and is below 2 * LEVEL again and again; from 120 on it is really small."""
    e = steady(1)
    e[0, 50:60] = np.nan
    e[0, 60:120] = np.sin(np.arange(60) * np.pi / 10)
    assert (np.abs(e[0, 60:120]) < 2 * LEVEL).sum() == 6
    assert recovery(make_trace(e))[0]["steps"] == {"1": 60}


def test_one_spike_of_noise_does_not_hide_a_return() -> None:
    """2.5 times the level once in the window: its RMS is sqrt((19 + 6.25) / 20) = 1.12 of the level."""
    e = steady(1)
    e[0, 50:60] = np.nan
    e[0, 65] = 2.5 * LEVEL
    assert recovery(make_trace(e))[0]["steps"] == {"1": 0}


def test_what_counts_as_the_former_level() -> None:
    """Only the WINDOW steps before the loss, those of them that there are; rounding alone has no level."""
    e = steady(1)
    e[0, : 50 - WINDOW] = 100.0
    e[0, 35:40] = np.nan  # lost twice: the second level is over 15 steps
    e[0, 50:60] = np.nan
    assert [loss["steps"]["1"] for loss in recovery(make_trace(e))] == [0, 0]
    e = steady(2)
    e[0, 0:10] = np.nan  # there was nothing before
    assert recovery(make_trace(e))[0]["steps"] == {"1": None, "2": None}
    e = np.full((1, K), 1e-16)
    e[0, 50:60] = np.nan
    e[0, 60:] = 1.9e-12
    assert recovery(make_trace(e, scale=1.0))[0]["steps"] == {"1": 0}, "below twice 1e-12 of the states (about 3)"
    e[0, 60:] = 1e-10
    assert recovery(make_trace(e, scale=1.0))[0]["steps"] == {"1": None}


def test_the_last_steps_of_a_run_are_too_few_to_tell() -> None:
    e = steady(1)
    e[0, 50 : K - WINDOW + 1] = np.nan
    assert recovery(make_trace(e))[0]["steps"] == {"1": None}
    e[0, K - WINDOW] = LEVEL
    assert recovery(make_trace(e))[0]["steps"] == {"1": 0}


def test_every_loss_of_every_node_in_order_and_none_where_nobody_was_lost() -> None:
    e = steady()
    e[2, 20:30], e[0, 100:110], e[2, 100:120] = np.nan, np.nan, np.nan
    assert [(loss["node"], loss["lost"]) for loss in recovery(make_trace(e))] == [
        (3, [20, 30]),
        (1, [100, 110]),
        (3, [100, 120]),
    ]
    assert recovery(make_trace(steady())) == []


def test_an_error_beyond_what_can_be_squared() -> None:
    e = steady(2)
    e[0, 50:60] = np.nan
    e[0, 60:80] = 1e200
    assert recovery(make_trace(e))[0]["steps"] == {"1": 20, "2": 0}


def test_metrics_of_a_node_that_was_away_are_over_the_steps_that_there_are() -> None:
    e = steady()
    e[1, 50:60], e[1, 60:120] = np.nan, 4.0
    e[1, 120:140] = np.nan
    trace = make_trace(e, flagged=np.array([[False] * K, [False] * 60 + [True] * 60 + [False] * 80, [False] * K]))
    found = metrics(trace, scenario(), {})
    node = found["nodes"]["2"]
    assert node["lost"] == [[50, 60], [120, 140]]
    assert node["rms"] == pytest.approx(np.sqrt((20 * 16 + 60 * LEVEL**2) / 80))
    assert node["final"] == pytest.approx(LEVEL)
    assert (node["flagged"], node["flagged_last"]) == (60, 0)
    assert found["nodes"]["1"] == {
        "rms": pytest.approx(LEVEL),
        "final": pytest.approx(LEVEL),
        "flagged": 0,
        "flagged_last": 0,
        "lost": [],
    }
    assert (found["verdict"], found["remarks"]) == ("not converged", [])
    assert [loss["lost"] for loss in found["recovery"]] == [[50, 60], [120, 140]]
    json.dumps(found, allow_nan=False)


def test_the_verdict_is_over_those_who_are_there_at_the_end_and_says_who_is_not() -> None:
    e = steady()
    e[1, 20:50], e[1, 50:] = 7.0, np.nan
    found = metrics(make_trace(e), scenario(), {})
    assert (found["verdict"], found["converged"]) == ("converged", True)
    assert found["remarks"] == ["node 2 is gone from step 50 on and not judged"]
    assert found["nodes"]["2"]["rms"] is None
    assert found["nodes"]["2"]["final"] == pytest.approx(7.0)
    assert metrics(make_trace(e), scenario(LEVEL / 2), {})["verdict"] == "not converged"
    e[0, 50:] = e[2, 50:] = np.nan
    assert metrics(make_trace(e), scenario(), {})["verdict"] == "incomplete", "nobody is left to be judged"


def test_a_run_that_failed_is_incomplete_though_its_nodes_may_go_missing() -> None:
    e = steady()
    e[1, 198:] = np.nan
    assert metrics(make_trace(e), scenario(), {"failure": "node-2 was killed"})["verdict"] == "incomplete"


def test_marks_at_the_end_are_said_beside_the_verdict() -> None:
    flags = np.zeros((3, K), dtype=bool)
    flags[0, 10:30] = flags[1, 160:] = flags[2, 160:] = True
    found = metrics(make_trace(steady(), flagged=flags), scenario(), {})
    assert found["verdict"] == "converged"
    assert found["remarks"] == ["nodes 2 and 3 flag their last 40 estimates"]
    assert [node["flagged_last"] for node in found["nodes"].values()] == [0, 40, 40]
    flags[1, :199], flags[0, 199] = True, True
    flags[1, 199] = False
    assert metrics(make_trace(steady(), flagged=flags), scenario(), {})["remarks"] == [
        "nodes 1 and 3 flag their last 1 to 40 estimates"
    ]
    flags[2, 199] = False
    assert metrics(make_trace(steady(), flagged=flags), scenario(), {})["remarks"] == ["node 1 flags its last estimate"]
    many = np.ones((9, K), dtype=bool)
    assert metrics(make_trace(steady(9), flagged=many), scenario(), {})["remarks"] == [
        "9 nodes flag their last 200 estimates"
    ]


def test_where_no_message_can_be_missing_a_missing_row_is_the_end_of_the_run() -> None:
    e = steady()
    e[1, 150:] = np.nan
    trace = make_trace(e)
    plain = Trace(trace.t, trace.x, trace.node_ids, trace.xhat)
    found = metrics(plain, scenario(), {})
    assert found["verdict"] == "incomplete"
    assert "recovery" not in found
    assert set(found["nodes"]["2"]) == {"rms", "final"}


def test_an_observer_that_has_left_the_floats_is_not_away() -> None:
    e = steady()
    e[1, 150:] = np.nan
    flags = np.zeros((3, K), dtype=bool)
    flags[1, 150:] = True
    found = metrics(make_trace(e, flagged=flags), scenario(), {})
    assert not found["converged"]
    assert found["nodes"]["2"]["lost"] == []
    assert found["recovery"] == []
