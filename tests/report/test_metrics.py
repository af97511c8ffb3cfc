"""RMS per component, the verdict, and what counts as no verdict."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from duio_mesh.report.metrics import converged, judged, metrics, rms_errors
from duio_mesh.scenario.model import Convergence
from duio_mesh.trace import Trace


def make_trace(errors: list[list[list[float]]]) -> Trace:
    """errors[i][k] of node i + 1; the truth is not zero, so that an error is not an estimate."""
    e = np.array(errors, dtype=np.float64)
    x = np.arange(e.shape[1] * e.shape[2], dtype=np.float64).reshape(e.shape[1:]) / 8
    return Trace(t=np.arange(e.shape[1]) * 0.5, x=x, node_ids=np.arange(1, len(e) + 1), xhat=x + e)


def scenario(steps: int, rms_below: float = 1.0, over_last: float = 0.5) -> Any:
    run = SimpleNamespace(convergence=Convergence(rms_below, over_last), steps=steps, seed=7)
    return SimpleNamespace(run=run, outside=None)


def test_rms_is_per_component() -> None:
    """Errors (3, 4) and (0, 0): the mean square of four numbers is 25/4."""
    trace = make_trace([[[3.0, 4.0], [0.0, 0.0]]])
    assert rms_errors(trace, slice(0, 2)).tolist() == [2.5]
    assert rms_errors(trace, slice(0, 1)).tolist() == [pytest.approx(5 / math.sqrt(2))]


def test_noise_alone_gives_the_level_that_the_paper_example_has() -> None:
    """Seed 000, example 6.2: y = C x + v with variance 0.2 and C x-hat = y at 3 of 9 states gives sqrt(3 * 0.2 / 9)."""
    rng = np.random.default_rng(0)
    error = np.zeros((1, 20_000, 9))
    error[:, :, :3] = math.sqrt(0.2) * rng.standard_normal((1, 20_000, 3))
    assert rms_errors(make_trace(error.tolist()), slice(0, None))[0] == pytest.approx(0.2582, rel=0.01)


@pytest.mark.parametrize(
    ("K", "over_last", "first"), [(101, 0.5, 51), (100, 0.5, 50), (10, 0.01, 9), (10, 1.0, 0), (1, 0.5, 0)]
)
def test_the_steps_that_the_verdict_looks_at(K: int, over_last: float, first: int) -> None:
    trace = make_trace([[[0.0]] * K])
    assert judged(trace, Convergence(1.0, over_last)) == slice(first, K)


def test_every_node_must_be_good_and_only_at_the_end() -> None:
    good, late = [[9.0], [9.0], [0.5], [-0.5]], [[0.0], [0.0], [0.0], [2.0]]
    wanted = Convergence(1.0, 0.5)
    assert converged(make_trace([good]), wanted)
    assert not converged(make_trace([good, late]), wanted)
    assert not converged(make_trace([good]), Convergence(0.5, 0.5)), "below means below"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_row_that_is_not_a_number_never_converges(bad: float) -> None:
    trace = make_trace([[[0.0], [0.0]], [[0.0], [bad]]])
    assert not converged(trace, Convergence(1e308, 1.0))
    found = metrics(trace, scenario(2, 1e308), {})
    assert found["converged"] is False
    assert found["nodes"]["1"] == {"rms": 0.0, "final": 0.0}
    assert found["nodes"]["2"] == {"rms": None, "final": None}
    json.dumps(found, allow_nan=False)


def test_a_run_without_a_step_or_with_too_few_has_not_converged() -> None:
    nothing = Trace(np.zeros(0), np.zeros((0, 2)), np.array([1]), np.zeros((1, 0, 2)))
    assert not converged(nothing, Convergence(1.0, 0.5))
    assert metrics(nothing, scenario(3), {})["verdict"] == "incomplete"
    short = metrics(make_trace([[[0.0], [0.0]]]), scenario(3), {})
    assert (short["verdict"], short["converged"], short["steps"]) == ("incomplete", False, 2)


def test_errors_beyond_what_can_be_squared() -> None:
    found = rms_errors(make_trace([[[3e200, 4e200]], [[3e-200, 4e-200]]]), slice(0, 1))
    assert found[0] == pytest.approx(5e200 / math.sqrt(2))


def test_what_metrics_json_holds() -> None:
    trace = make_trace([[[2.0], [0.25]], [[0.0], [0.5]]])
    counts = {"rounds": 2, "rounds_per_second": 11.5, "messages": 8, "rejected": {"node-1": {"late": 1}}}
    found = metrics(trace, scenario(2), counts)
    assert found["verdict"] == "converged"
    assert found["nodes"] == {"1": {"rms": 0.25, "final": 0.25}, "2": {"rms": 0.5, "final": 0.5}}
    assert {name: found[name] for name in counts} == counts
    assert (found["steps"], found["seed"]) == (2, 7)
    assert found["criterion"] == {"rms_below": 1.0, "from_step": 1}
    raw = b"".join(struct.pack("<d", value) for value in trace.xhat.ravel().tolist())
    assert found["estimates_sha256"] == hashlib.sha256(raw).hexdigest()
    assert json.loads(json.dumps(found)) == found


def test_the_hash_does_not_depend_on_the_layout_in_memory() -> None:
    trace = make_trace([[[1.0, 2.0], [3.0, 4.0]]])
    turned = Trace(trace.t, trace.x, trace.node_ids, np.asfortranarray(trace.xhat))
    hashes = {metrics(t, scenario(2), {})["estimates_sha256"] for t in (trace, turned)}
    assert len(hashes) == 1
