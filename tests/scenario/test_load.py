"""What a valid file means: the scenario that comes out, plant files, the resolved file, and what is not imported."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duio_mesh.dynamics import SIGNALS, signal
from duio_mesh.scenario import scenario_yaml
from duio_mesh.scenario.model import Arc, Feedback, Lqr, Normal, OpenLoop, Scenario
from tests.scenario.broken import PLANT_FILE, VALID, without
from tests.scenario.same import same
from tests.scenario.stand_in import Poles, load

NOBODY = np.random.default_rng(0)


def with_(tmp_path: Path, *edits: tuple[str, str]) -> Scenario:
    """The valid file with each (old, new) replaced."""
    text = VALID
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (tmp_path / "t.yaml").write_text(text)
    return load(tmp_path / "t.yaml")


def test_every_part_arrives(tmp_path: Path) -> None:
    s = with_(tmp_path)
    assert (s.name, s.description, s.method) == ("tiny", "Two states, two nodes", "lmi")
    assert (s.plant.time, s.plant.step, s.plant.inputs, s.plant.n) == ("discrete", 1.0, ("heater",), 2)
    assert np.array_equal(s.plant.A, [[0.5, 0.1], [0.0, 0.5]])
    assert np.array_equal(s.plant.B, [[1], [0]])
    assert np.array_equal(s.plant.E, [[0], [1]])
    assert isinstance(s.plant.x0, np.ndarray)
    assert np.array_equal(s.plant.x0, [1, 0])
    assert s.plant.control == OpenLoop((({"sine": {"amplitude": 1.0, "period": 10.0, "phase": 0.0}},),))
    assert s.plant.disturbance == (({"constant": {"value": 1.0}},),)
    assert list(s.nodes) == [1, 2]
    assert s.nodes[1].knows == ("heater",)
    assert np.array_equal(s.nodes[2].C, [[0, 1]])
    assert np.array_equal(s.nodes[1].noise.channel, [[1]])
    assert s.nodes[1].noise.signals == (({"normal": {"mean": 0.0, "std": 0.1}},),)
    assert s.graph.arcs == (Arc(1, 2, 1.0), Arc(2, 1, 1.0))
    assert not s.graph.directed
    assert (s.run.steps, s.run.seed, s.run.deadline, s.run.window) == (10, 0, 5.0, 256)
    assert s.run.convergence == (0.5, 0.5)
    assert s.options.decomposition == "observability"
    for array in (s.plant.A, s.plant.B, s.plant.E, s.nodes[1].C):
        assert array.dtype == np.float64


def test_leaving_everything_out(tmp_path: Path) -> None:
    s = with_(
        tmp_path,
        (without("  B:", "  x0:"), ""),
        (without("  control:", "observer:"), ""),
        (", knows: [heater]", ""),
        (", knows: []", ""),
        ("edges: [[1, 2]]", "edges: []"),
        ("description: Two states, two nodes\n", ""),
        (", over_last: 0.5", ""),
        ("  seed: 0\n", ""),
    )
    assert s.plant.B.shape == s.plant.E.shape == (2, 0)
    assert (s.plant.inputs, s.plant.control, s.plant.disturbance) == ((), OpenLoop(()), ())
    assert s.nodes[1].noise.channel.shape == (1, 0)
    assert s.graph.islands() == ((1,), (2,))
    assert (s.description, s.run.seed, s.run.convergence.over_last) == ("", 0, 0.5)


def test_control_forms(tmp_path: Path) -> None:
    now = "{signals: {heater: {sine: {amplitude: 1, period: 10}}}}"
    lqr = with_(tmp_path, (now, "{lqr: {Q: [1, 2], R: 3, reference: [4, 5]}}")).plant.control
    assert isinstance(lqr, Lqr)
    assert np.array_equal(lqr.Q, [[1, 0], [0, 2]])
    assert np.array_equal(lqr.R, [[3]])
    assert np.array_equal(lqr.reference, [4, 5])
    full = with_(tmp_path, (now, "{lqr: {Q: [[2, 1], [1, 2]], R: [[1]]}}")).plant.control
    assert isinstance(full, Lqr)
    assert np.array_equal(full.Q, [[2, 1], [1, 2]])
    assert np.array_equal(full.reference, [0, 0])
    given = with_(tmp_path, (now, "{F: [[-1, 0.5]], reference: [1, 1]}")).plant.control
    assert isinstance(given, Feedback)
    assert np.array_equal(given.F, [[-1, 0.5]])
    assert np.array_equal(given.reference, [1, 1])
    assert with_(tmp_path, (now, "{signals: [2]}")).plant.control == OpenLoop((({"constant": {"value": 2.0}},),))
    assert with_(tmp_path, (now, "{signals: {}}")).plant.control == OpenLoop(((),))


def test_random_initial_state(tmp_path: Path) -> None:
    x0 = with_(tmp_path, ("x0: [1.0, 0.0]", "x0: {normal: {mean: 18, std: [3, 0]}}")).plant.x0
    assert isinstance(x0, Normal)
    assert np.array_equal(x0.mean, [18, 18])
    assert np.array_equal(x0.std, [3, 0])


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("2", lambda t: 2.0),
        ("{constant: {value: -1}}", lambda t: -1.0),
        ("{sine: {period: 4}}", lambda t: math.sin(math.pi * t / 2)),
        ("{sine: {rate: 1.5, amplitude: 3, phase: 0.2}}", lambda t: 3 * math.sin(1.5 * t + 0.2)),
        ("{cosine: {rate: 0.25}}", lambda t: math.cos(t / 4)),
        ("{step: {time: 1.7, after: 5}}", lambda t: 5.0 if t >= 1.7 else 0.0),
        ("{step: {time: 2, after: 5, before: 1}}", lambda t: 5.0 if t >= 2 else 1.0),
        ("{square: {period: 2, amplitude: 3}}", lambda t: 3.0 if t % 2 < 1 else -3.0),
        ("[1, {constant: {value: 2}}, {sine: {rate: 1}}]", lambda t: 3 + math.sin(t)),
        ("0", lambda t: 0.0),
        ("[]", lambda t: 0.0),
    ],
)
def test_signals_mean_what_is_written(tmp_path: Path, written: str, value: Any) -> None:
    terms = with_(tmp_path, ("{constant: {value: 1}}", written)).plant.disturbance[0]
    for t in (0.0, 0.3, 1.7, 2.1, 3.25):
        assert signal(terms, t, NOBODY) == pytest.approx(value(t), abs=1e-12)


@pytest.mark.parametrize("written", ["{normal: {std: 2}}", "{normal: {variance: 4, mean: 0}}"])
def test_normal_signals(tmp_path: Path, written: str) -> None:
    terms = with_(tmp_path, ("{constant: {value: 1}}", written)).plant.disturbance[0]
    expected = 2 * np.random.default_rng(5).standard_normal()
    assert signal(terms, 0.0, np.random.default_rng(5)) == expected


def test_every_signal_of_the_dynamics_can_be_written(tmp_path: Path) -> None:
    needs = {"constant": "value: 1", "step": "time: 1, after: 1", "normal": "std: 1"}
    for kind in SIGNALS:
        written = f"{{{kind}: {{{needs.get(kind, 'period: 1')}}}}}"
        terms = with_(tmp_path, ("{constant: {value: 1}}", written)).plant.disturbance[0]
        assert math.isfinite(signal(terms, 0.5, NOBODY)), kind


@pytest.mark.parametrize(
    ("plant", "node", "channel", "count"),
    [
        ("noise: {std: 0.5}", "knows: []", [[1.0]], 1),
        ("noise: {variance: 0.25}", "noise: 0", np.zeros((1, 0)), 0),
        ("noise: {variance: 0}", "knows: []", np.zeros((1, 0)), 0),
        ("noise: 0", "noise: {channel: [[2, 3]], signals: [1, 0]}", [[2.0, 3.0]], 2),
        ("noise:", "noise: {std: 0.5}", [[1.0]], 1),
        ("noise: {channel: [[2]], signals: [{sine: {rate: 1}}]}", "knows: []", [[2.0]], 1),
    ],
)
def test_noise_of_node_2(tmp_path: Path, plant: str, node: str, channel: Any, count: int) -> None:
    noise = with_(tmp_path, ("noise: {variance: 0.01}", plant), ("knows: []", node)).nodes[2].noise
    assert np.array_equal(noise.channel, channel)
    assert len(noise.signals) == count


def test_noise_deviation_is_the_root_of_the_variance(tmp_path: Path) -> None:
    noise = with_(tmp_path, ("variance: 0.01", "variance: 0.2")).nodes[1].noise
    draws = np.random.default_rng(1)
    assert signal(noise.signals[0], 0.0, np.random.default_rng(1)) == math.sqrt(0.2) * draws.standard_normal()


def test_directed_and_weighted(tmp_path: Path) -> None:
    graph = with_(tmp_path, ("edges: [[1, 2]]", "arcs: [[2, 1, 0.5]]")).graph
    assert graph.directed
    assert graph.arcs == (Arc(2, 1, 0.5),)
    assert graph.hears(1) == {2: 0.5}
    assert graph.hears(2) == {}
    weighted = with_(tmp_path, ("[[1, 2]]", "[[2, 1, 3]]")).graph
    assert weighted.arcs == (Arc(1, 2, 3.0), Arc(2, 1, 3.0))


def test_continuous_time(tmp_path: Path) -> None:
    s = with_(tmp_path, ("discrete\n  period: 1.0", "continuous"), ("seed: 0", "step: 0.005"))
    assert (s.plant.time, s.plant.step) == ("continuous", 0.005)


def test_nodes_are_in_ascending_order(tmp_path: Path) -> None:
    s = with_(tmp_path, ("  1: {C", "  20: {C"), ("[[1, 2]]", "[[20, 2]]"))
    assert list(s.nodes) == list(s.graph.ids) == [2, 20]


def test_options_of_the_method(tmp_path: Path) -> None:
    s = with_(tmp_path, ("decomposition: observability", "local_gain: {poles: [0.1, 1]}"))
    assert s.options.local_gain == Poles(poles=(0.1, 1.0))


def test_plant_file_equals_plant_in_place(tmp_path: Path) -> None:
    (tmp_path / "plants").mkdir()
    (tmp_path / "plants" / "p.yaml").write_text(PLANT_FILE)
    inside = "plant:\n" + "".join(f"  {line}\n" for line in PLANT_FILE.splitlines())
    referred = with_(tmp_path, (without("plant:", "observer:"), "plant: plants/p.yaml\n"))
    assert same(referred, with_(tmp_path, (without("plant:", "observer:"), inside)))


def test_the_resolved_file_is_the_same_scenario(tmp_path: Path) -> None:
    s = with_(tmp_path, ("description: Two states, two nodes", 'description: "1e3"'), ("  seed: 0\n", ""))
    text = scenario_yaml(s, {"duio_mesh": "0.1.0", "note": "two\nlines"})
    assert "# note: two lines\n" in text
    assert "  seed: 0\n" in text
    (tmp_path / "scenario.yaml").write_text(text)
    again = load(tmp_path / "scenario.yaml")
    assert same(again, s)
    assert scenario_yaml(again, {}) == scenario_yaml(s, {})


@pytest.mark.parametrize(
    "text", ["", "~", "no", "1_000", "0o7", ".5e3", "1.", "- a", "a: b", "é🌡", "a\nb", "#", "0x1", "=", "<<"]
)
def test_texts_survive_the_resolved_file(tmp_path: Path, text: str) -> None:
    s = with_(tmp_path)
    document = {**s.document, "description": text}
    (tmp_path / "scenario.yaml").write_text(scenario_yaml(type(s)(**{**vars(s), "document": document}), {}))
    assert load(tmp_path / "scenario.yaml").description == text


def test_reading_loads_no_solver() -> None:
    heavy = {"scipy", "cvxpy", "matplotlib", "rerun", "networkx", "zenoh"}
    code = f"import sys, duio_mesh.scenario; sys.exit(', '.join({heavy} & set(sys.modules)) or None)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
