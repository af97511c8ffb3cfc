"""``--plot``: a run as PNG figures, like those in the papers (seed 000, figures 2, 3, 6, 7, 8)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from duio_mesh.arrays import Array
from duio_mesh.report.entities import palette, spread
from duio_mesh.report.pairing import Decimator, log_norms
from duio_mesh.scenario.model import Scenario
from duio_mesh.trace import Trace

AXES = 12  # nodes or states that one figure shows
LINES = 16  # lines in one axes
POINTS = 4000  # of one line; more are thinned to the least and the greatest of every stretch
DPI = 120
FEW = 3  # steps, below which a line is little or nothing and needs markers to be seen
SHADE = "#d29922"  # of flagged steps
GREY = "0.5"  # of the legend's "flagged" where every node has its own colour for it


def figures(folder: Path, scenario: Scenario, trace: Trace) -> list[Path]:
    """Draw what the trace has into ``folder``; the files written.

    errors.png (every node's error, one line per state), error_norms.png (log scale, all nodes), states.png,
    estimates.png (every state with all nodes' estimates), and, where the method reconstructs them,
    unknown_inputs.png and noise.png. Steps whose estimates the node flags are shaded in a node's own axes, and where
    nodes share one their lines have a broad shade there. Where not all nodes, states or inputs have room the title says
    how many are shown. Raises OSError when a file cannot be written.
    """
    drawing = _Drawing(folder, scenario, trace)
    if drawing.known:
        drawing.errors()
        drawing.error_norms()
        drawing.states()
    drawing.estimates()
    if trace.what is not None:
        drawing.unknown_inputs(trace.what)
    if trace.vhat:
        drawing.noise()
    return drawing.written


class _Drawing:
    def __init__(self, folder: Path, scenario: Scenario, trace: Trace) -> None:
        self._folder, self._name, self._trace = folder, scenario.name, trace
        self._ids = trace.node_ids.tolist()
        self._colours = {i: _hex(c) for i, c in zip(self._ids, palette(len(self._ids)), strict=True)}
        self.known = not len(trace.x) or not np.isnan(trace.x).all()  # whether somebody knew the true state
        self._hours = bool(len(trace.t)) and float(trace.t[-1]) >= 7200
        self._time = trace.t / 3600 if self._hours else trace.t
        self._states = range(trace.x.shape[1])
        self.written: list[Path] = []

    def errors(self) -> None:
        """One axes per node, one line per state: as the papers show them."""
        nodes, states = spread(self._ids, AXES), spread(self._states, LINES)

        def draw(axes: Any, i: int) -> None:
            _distinct(axes, len(states))
            error = self._trace.xhat[self._ids.index(i)] - self._trace.x
            for c in states:
                self._line(axes, error[:, c], label=f"$x_{{{c + 1}}}$", lw=0.9)
            self._shade(axes, i)
            axes.set(title=f"node {i}", ylabel=rf"$\hat x_{{{i}}} - x$")
            axes.axhline(0, color="0.6", lw=0.6, zorder=0)

        title = self._title("Estimation errors", self._of_nodes(nodes), self._of_states(states))
        self._grid("errors.png", title, nodes, draw, share=True)

    def error_norms(self) -> None:
        """All nodes' 2-norms on a log scale."""

        def draw(axes: Any, _: int) -> None:
            for at, i in enumerate(self._ids):
                with np.errstate(over="ignore", invalid="ignore"):
                    norms = log_norms(self._trace.xhat[at] - self._trace.x)
                self._own_line(axes, i, norms, lw=1.1)
            axes.set(ylabel=r"$\log_{10} \|\hat x_i - x\|_2$")

        self._grid("error_norms.png", self._title("Estimation error norms"), [0], draw)

    def states(self) -> None:
        """The true states in one axes."""

        states = spread(self._states, LINES)

        def draw(axes: Any, _: int) -> None:
            _distinct(axes, len(states))
            for c in states:
                self._line(axes, self._trace.x[:, c], label=f"$x_{{{c + 1}}}$", lw=1.1)
            axes.set(ylabel="$x$")

        self._grid("states.png", self._title("States of the plant", self._of_states(states)), [0], draw)

    def estimates(self) -> None:
        """One axes per state: the truth, and what every node thinks of it."""
        nodes, states = spread(self._ids, LINES), spread(self._states, AXES)

        def draw(axes: Any, c: int) -> None:
            if self.known:
                self._line(axes, self._trace.x[:, c], color="0.65", lw=3, label="truth")
            for i in nodes:
                own = self._trace.xhat[self._ids.index(i), :, c]
                self._own_line(axes, i, own)
            axes.set(title=f"$x_{{{c + 1}}}$")

        what = "States and their estimates" if self.known else "Estimates"
        title = self._title(what, self._of_nodes(nodes), self._of_states(states))
        self._grid("estimates.png", title, states, draw)

    def unknown_inputs(self, what: Array) -> None:
        """One axes per unknown input, one line per node."""
        nodes, inputs = spread(self._ids, LINES), spread(range(what.shape[2]), AXES)

        def draw(axes: Any, j: int) -> None:
            for i in nodes:
                own = what[self._ids.index(i), :, j]
                self._own_line(axes, i, own)
            axes.set(title=f"$w_{{{j + 1}}}$")

        some = _some(inputs, what.shape[2], "unknown inputs")
        title = self._title("Reconstructed unknown inputs", self._of_nodes(nodes), some)
        self._grid("unknown_inputs.png", title, inputs, draw)

    def noise(self) -> None:
        """One axes per node, one line per noise."""
        nodes = spread(sorted(self._trace.vhat), AXES)

        def draw(axes: Any, i: int) -> None:
            count = self._trace.vhat[i].shape[1]
            noises = spread(range(count), LINES)
            for j in noises:
                self._line(axes, self._trace.vhat[i][:, j], lw=0.9, label=f"$v_{{{j + 1}}}$")
            self._shade(axes, i)
            some = _some(noises, count, "noises")
            axes.set(title=f"node {i}{some and f' ({some})'}", ylabel=rf"$\hat v_{{{i}}}$")

        some = _some(nodes, len(self._trace.vhat), "nodes")
        self._grid("noise.png", self._title("Reconstructed measurement noise", some), nodes, draw)

    def _of_nodes(self, shown: Sequence[int]) -> str:
        return _some(shown, len(self._ids), "nodes")

    def _of_states(self, shown: Sequence[int]) -> str:
        return _some(shown, len(self._states), "states")

    def _title(self, what: str, *parts: str) -> str:
        """What a figure shows, of which run, and how much of it where that is not all."""
        said = ", ".join(filter(None, parts))
        return f"{what}: {self._name}" + (f"\n({said})" if said else "")

    def _grid(
        self, file: str, title: str, items: Sequence[int], draw: Callable[[Any, int], None], *, share: bool = False
    ) -> None:
        """One axes per item, drawn by ``draw(axes, item)``, with one legend beside them."""
        from matplotlib.figure import Figure  # without pyplot: draws into memory, opens no window, changes no setting

        columns = 1 if len(items) == 1 else 2 if len(items) <= 4 else 3
        rows = -(-len(items) // columns)
        size = (8.0, 4.5) if len(items) == 1 else (4.2 * columns + 1, 2.5 * rows + 0.6)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=share)
        for axes, item in zip(grid.flat, items, strict=False):
            draw(axes, item)
            axes.grid(alpha=0.3)
            axes.margins(x=0)
        for axes in grid.flat[len(items) :]:
            axes.set_visible(False)
        for column in range(columns):
            lowest = grid[(len(items) - 1 - column) // columns, column]
            lowest.set_xlabel("t [h]" if self._hours else "t [s]")
            lowest.tick_params(labelbottom=True)
        shown = [axes.get_legend_handles_labels() for axes in grid.flat]
        named = dict(zip(shown[0][1], shown[0][0], strict=True))  # one entry of each name
        named.pop("flagged", None)
        shaded = [dict(zip(names, handles, strict=True)) for handles, names in shown if "flagged" in names]
        named |= {"flagged": _anybody_s(shaded[0]["flagged"])} if shaded else {}
        figure.legend(named.values(), named.keys(), loc="outside right upper", frameon=False)
        figure.suptitle(title)
        path = self._folder / file
        figure.savefig(path, dpi=DPI)
        self.written.append(path)

    def _flags(self, i: int) -> NDArray[np.bool_]:
        """(K,) where node i's flags are to be drawn: up to the step after, and at least as wide as a line's points."""
        flagged, K = self._trace.flagged, len(self._time)
        if flagged is None or not K:
            return np.zeros(K, dtype=bool)
        own = flagged[self._ids.index(i)].copy()
        own[1:] |= own[:-1]
        stride = _stride(K)
        return np.repeat(np.logical_or.reduceat(own, np.arange(0, K, stride)), stride)[:K]

    def _shade(self, axes: Any, i: int) -> None:
        """The spans of steps that node i flags, behind the lines of its own axes."""
        if (flags := self._flags(i)).any():
            whole = axes.get_xaxis_transform()
            style = {"color": SHADE, "alpha": 0.25, "lw": 0, "label": "flagged", "zorder": 0}
            axes.fill_between(self._time, 0, 1, where=flags, transform=whole, **style)

    def _own_line(self, axes: Any, i: int, values: Array, lw: float = 0.9) -> None:
        """Node i's line among those of others, with a broad shade of it where it flags its estimates."""
        if (flags := self._flags(i)).any():
            alone = np.where(flags, values, np.nan)
            self._line(axes, alone, color=self._colours[i], lw=6, alpha=0.3, label="flagged", solid_capstyle="butt")
        self._line(axes, values, color=self._colours[i], lw=lw, label=f"node {i}")

    def _line(self, axes: Any, values: Array, **style: Any) -> None:
        """A line that keeps its spikes however long it is."""
        thinned = Decimator(_stride(len(values)))
        parts = (thinned.push(np.arange(len(values)), values), thinned.drain())
        steps, kept = (np.concatenate(column) for column in zip(*parts, strict=True))
        if len(values) < FEW:
            style |= {"marker": "o", "markersize": style["lw"] + 3}
        axes.plot(self._time[steps], kept, **style)


def _some(shown: Sequence[int], count: int, what: str) -> str:
    """How many of them are shown; nothing where all are."""
    return f"{len(shown)} of {count} {what}" if len(shown) < count else ""


def _anybody_s(flagged: Any) -> Any:
    """The legend's handle of flagged steps: grey instead of the colour of the one node whose line it is."""
    from matplotlib.lines import Line2D

    if not isinstance(flagged, Line2D):  # a shade in a node's own axes has a colour of its own
        return flagged
    return Line2D([], [], color=GREY, lw=flagged.get_linewidth(), alpha=flagged.get_alpha())


def _stride(steps: int) -> int:
    """Steps of which a line keeps two points."""
    return max(1, -(-2 * steps // POINTS))


def _distinct(axes: Any, lines: int) -> None:
    """Colours that do not repeat, where matplotlib's own ten would."""
    if lines > 10:
        axes.set_prop_cycle(color=[_hex(colour) for colour in palette(lines)])


def _hex(colour: int) -> str:
    return f"#{colour >> 8:06x}"
