"""--plot: the figures exist, show the numbers of the trace, and need no display."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from duio_mesh.report import figures as module
from duio_mesh.report.figures import figures
from duio_mesh.trace import Trace

SCENARIO: Any = SimpleNamespace(name="synthetic")


def make_trace(nodes: int = 3, K: int = 40, n: int = 4, **extra: Any) -> Trace:
    rng = np.random.default_rng(0)
    x = rng.standard_normal((K, n)).cumsum(axis=0)
    xhat = x + rng.standard_normal((nodes, K, n)) * 0.9 ** np.arange(K)[:, None]
    return Trace(t=np.arange(K) * 0.5, x=x, node_ids=np.arange(1, nodes + 1), xhat=xhat, **extra)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """file name -> the matplotlib figure that was saved under it."""
    from matplotlib.figure import Figure

    kept: dict[str, Any] = {}
    save = Figure.savefig

    def savefig(self: Any, path: Path, **options: Any) -> None:
        kept[Path(path).name] = self
        save(self, path, **options)

    monkeypatch.setattr(Figure, "savefig", savefig)
    return kept


def lines(axes: Any) -> list[Any]:
    """The lines with a label: not those that mark zero."""
    return [line for line in axes.get_lines() if not line.get_label().startswith("_")]


def test_the_figures_show_the_trace(tmp_path: Path, drawn: dict[str, Any]) -> None:
    trace = make_trace()
    written = figures(tmp_path, SCENARIO, trace)
    assert [path.name for path in written] == ["errors.png", "error_norms.png", "states.png", "estimates.png"]
    for path in written:
        assert path.read_bytes().startswith(b"\x89PNG")
    errors = drawn["errors.png"].axes
    assert [axes.get_title() for axes in errors if axes.get_visible()] == ["node 1", "node 2", "node 3"]
    for at, axes in enumerate(errors[:3]):
        for c, line in enumerate(lines(axes)):
            np.testing.assert_array_equal(line.get_xdata(), trace.t)
            np.testing.assert_array_equal(line.get_ydata(), trace.xhat[at, :, c] - trace.x[:, c])
    for at, line in enumerate(lines(drawn["error_norms.png"].axes[0])):
        np.testing.assert_allclose(10 ** line.get_ydata(), np.linalg.norm(trace.xhat[at] - trace.x, axis=1))
    for c, line in enumerate(lines(drawn["states.png"].axes[0])):
        np.testing.assert_array_equal(line.get_ydata(), trace.x[:, c])
    for c, axes in enumerate(drawn["estimates.png"].axes):
        shown = [line.get_ydata().tolist() for line in lines(axes)]
        assert shown == [trace.x[:, c].tolist(), *(trace.xhat[at, :, c].tolist() for at in range(3))]


def test_a_node_has_one_colour_in_all_figures(tmp_path: Path, drawn: dict[str, Any]) -> None:
    figures(tmp_path, SCENARIO, make_trace(what=np.zeros((3, 40, 2))))
    colours = {
        (name, line.get_label(), line.get_color())
        for name in ("error_norms.png", "estimates.png", "unknown_inputs.png")
        for axes in drawn[name].axes
        for line in lines(axes)
    }
    for i in (1, 2, 3):
        assert len({colour for _, label, colour in colours if label == f"node {i}"}) == 1
    assert len({colour for _, _, colour in colours}) == 4, "three nodes and the truth"


def test_what_a_method_reconstructs_is_drawn(tmp_path: Path, drawn: dict[str, Any]) -> None:
    rng = np.random.default_rng(1)
    trace = make_trace(
        what=rng.standard_normal((3, 40, 2)), vhat={1: rng.standard_normal((40, 1)), 3: np.ones((40, 2))}
    )
    written = figures(tmp_path, SCENARIO, trace)
    assert [path.name for path in written][-2:] == ["unknown_inputs.png", "noise.png"]
    assert trace.what is not None
    for j, axes in enumerate(drawn["unknown_inputs.png"].axes):
        for at, line in enumerate(lines(axes)):
            np.testing.assert_array_equal(line.get_ydata(), trace.what[at, :, j])
    first, second = drawn["noise.png"].axes
    assert (first.get_title(), second.get_title()) == ("node 1", "node 3")
    assert [len(lines(axes)) for axes in (first, second)] == [1, 2]


@pytest.mark.parametrize(("nodes", "K", "n"), [(1, 2, 1), (5, 3, 2), (20, 5, 30), (2, 0, 2)])
def test_any_size_and_any_number_can_be_drawn(tmp_path: Path, nodes: int, K: int, n: int) -> None:
    trace = make_trace(nodes, K, n)
    if K > 2:
        trace.xhat[0, 1:] = np.nan
        trace.xhat[1, 2] = np.inf
    for path in figures(tmp_path, SCENARIO, trace):
        assert path.stat().st_size > 1000


def test_a_long_line_keeps_its_spike(tmp_path: Path, drawn: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "POINTS", 100)
    trace = make_trace(nodes=1, K=5000, n=1)
    trace.xhat[0, 3217, 0] = trace.x[3217, 0] + 1e5
    figures(tmp_path, SCENARIO, trace)
    (line,) = lines(drawn["errors.png"].axes[0])
    assert len(line.get_ydata()) <= 100
    assert (trace.t[3217], pytest.approx(1e5)) in list(zip(line.get_xdata(), line.get_ydata(), strict=True))


def test_what_is_light_does_not_load_what_is_heavy() -> None:
    """The launcher imports these for every run; rerun and matplotlib cost half a second each."""
    code = (
        "import sys; from duio_mesh.report import description, entities, figures, metrics, pairing, trace_file\n"
        "print([name for name in ('rerun', 'matplotlib', 'networkx', 'scipy', 'zenoh') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_drawing_leaves_the_program_s_matplotlib_alone(tmp_path: Path) -> None:
    """No pyplot, no change of backend: a notebook that calls it keeps its own."""
    code = (
        "import sys, numpy as np; from pathlib import Path; from types import SimpleNamespace\n"
        "from duio_mesh.report.figures import figures; from duio_mesh.trace import Trace\n"
        "t = Trace(np.arange(3.), np.ones((3, 1)), np.array([1]), np.ones((1, 3, 1)))\n"
        f"figures(Path({str(tmp_path)!r}), SimpleNamespace(name='x'), t)\n"
        "print('matplotlib.pyplot' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_flagged_is_grey_in_the_legend_of_axes_that_nodes_share(tmp_path: Path, drawn: dict[str, Any]) -> None:
    """It is no node's colour: every node has its own under its line."""
    flagged = np.zeros((3, 40), dtype=bool)
    flagged[1, 5:9] = True
    figures(tmp_path, SCENARIO, make_trace(flagged=flagged))
    for name, colour in {
        "error_norms.png": module.GREY,
        "estimates.png": module.GREY,
        "errors.png": module.SHADE,
    }.items():
        legend = drawn[name].legends[0]
        at = [text.get_text() for text in legend.get_texts()].index("flagged")
        handle = legend.legend_handles[at]
        shown = handle.get_color() if name != "errors.png" else handle.get_facecolor()
        assert to_hex(shown) == to_hex(colour), name


@pytest.mark.parametrize(("K", "marker"), [(1, "o"), (2, "o"), (3, "None")])
def test_a_run_of_next_to_no_steps_has_markers(K: int, marker: str, tmp_path: Path, drawn: dict[str, Any]) -> None:
    figures(tmp_path, SCENARIO, make_trace(K=K))
    for name, figure in drawn.items():
        assert {line.get_marker() for axes in figure.axes for line in lines(axes)} == {marker}, name


def test_a_title_says_what_is_shown_only_in_part(tmp_path: Path, drawn: dict[str, Any]) -> None:
    what = np.zeros((20, 5, 13))
    figures(tmp_path, SCENARIO, make_trace(20, 5, 24, what=what, vhat={i: np.zeros((5, 17)) for i in range(1, 14)}))
    assert {name: figure.get_suptitle().partition("\n")[2] for name, figure in drawn.items()} == {
        "errors.png": "(12 of 20 nodes, 16 of 24 states)",
        "error_norms.png": "",
        "states.png": "(16 of 24 states)",
        "estimates.png": "(16 of 20 nodes, 12 of 24 states)",
        "unknown_inputs.png": "(16 of 20 nodes, 12 of 13 unknown inputs)",
        "noise.png": "(12 of 13 nodes)",
    }
    assert drawn["noise.png"].axes[0].get_title() == "node 1 (16 of 17 noises)"
    figures(tmp_path, SCENARIO, make_trace())
    assert drawn["errors.png"].get_suptitle() == "Estimation errors: synthetic"
