"""How a recording looks in the Rerun viewer: its tabs, views and styles. All unstable parts of Rerun's API are here."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from duio_mesh.report.entities import DESCRIPTION, EVENTS, FLAGS, GAPS, RATES, STATES, TRUTH, WATCHED, Entities, spread
from duio_mesh.report.topology import positions

DISTANCE = "Distance from the mean estimate: log10 ‖x̂ − mean‖"  # where nobody knows the true state
VIEWS = 12  # states that are shown side by side
LINES = 16  # nodes whose lines share a view, and nodes with a tab of their own
LEGEND = 12  # lines that a legend names
NAMED, WORDS = 32, 8  # nodes that are named in the topology view, and that are called more than their id
LABEL = 0xE6EDF3FF
NODE, RING, EDGE = 0.16, 0.23, 0.035  # radii in the topology view, where neighbours are about 1 apart


def blueprint(entities: Entities, *, rates: bool, worst: Sequence[int] = ()) -> rrb.Blueprint:
    """Tabs: overview, estimates, what else is reconstructed, the run. ``rates``: whether the recording has any.

    Where there are more nodes than ``LINES``, only some of their estimates are shown: ``worst``, once that is known.
    """
    tabs = [_overview(entities), _estimates(entities, worst), *_reconstruction(entities), *_rounds(entities)]
    tabs.append(_run(entities, rates))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="following"),
        auto_views=False,
        auto_layout=False,
    )


def styles(entities: Entities, description: str) -> Iterator[tuple[str, Any]]:
    """Everything that does not change with time: (entity path, archetype)."""
    yield DESCRIPTION, rr.TextDocument(description, media_type=rr.MediaType.MARKDOWN)
    yield entities.rate("plant"), _line("plant", TRUTH, 4.0)
    for _, path in entities.truth:
        yield path, _line("truth", TRUTH, 4.0)
    for i in entities.ids:
        watched = [entities.rounds(kind, i) for kind in WATCHED if entities.spec.watch_step is not None]
        watched += [entities.gap(i)] if entities.spec.tick else []
        for path in (entities.error(i), entities.rate(f"node-{i}"), *watched):
            yield path, _line(f"node {i}", entities.colours[i], 1.5)
        for _, path in entities.estimates(i):
            name = path.rsplit("/", 1)[1] if path.startswith("/noise") else f"node {i}"
            further = name.startswith("v") and name != "v1"  # noises of one node: the viewer's colours
            yield path, _line(name, None if further else entities.colours[i], 1.5)
    lanes = rr.StateConfiguration(values=list(STATES), colors=np.array(list(STATES.values()), dtype=np.uint32))
    for who in ("plant", *(f"node-{i}" for i in entities.ids)):
        yield entities.alive(who), lanes
    marks = rr.StateConfiguration(values=list(FLAGS), colors=np.array(list(FLAGS.values()), dtype=np.uint32))
    for i in entities.ids if entities.spec.flags else ():
        yield entities.flag(i), marks
    yield from _map(entities)


def states(values: list[str]) -> Any:
    """How a process or an estimate is, as a column of its lane."""
    return rr.StateChange.columns(state=values)


def node_colours(colours: list[int]) -> Any:
    """Colours of a node's ring in the topology view, as a column."""
    return rr.Points2D.columns(colors=np.array(colours, dtype=np.uint32))


def edge_colours(colours: list[int], *, both_ways: bool) -> Any:
    """Colours of an edge in the topology view, as a column."""
    kind = rr.LineStrips2D if both_ways else rr.Arrows2D
    return kind.columns(colors=np.array(colours, dtype=np.uint32))


def _line(name: str, colour: int | None, width: float) -> rr.SeriesLines:
    # MinMax: where a pixel covers many steps both extremes are drawn; an average would wash a spike out
    colours = None if colour is None else np.array([colour], dtype=np.uint32)
    return rr.SeriesLines(
        names=[name], colors=colours, widths=[width], aggregation_policy=rr.components.AggregationPolicy.MinMax
    )


def _map(entities: Entities) -> Iterator[tuple[str, Any]]:
    """The topology: nodes in their own colours with their ids, rings for how they are, edges."""
    at = positions(entities.ids, entities.spec.arcs)
    for (i, j), both_ways in entities.edges.items():
        if both_ways:
            yield entities.edge(i, j), rr.LineStrips2D([[at[i], at[j]]], radii=[EDGE], draw_order=0.0)
        else:
            source, target = (i, j) if (i, j) in entities.spec.arcs else (j, i)
            a, b = np.array(at[source]), np.array(at[target])
            along = (b - a) * (1 - RING / max(float(np.linalg.norm(b - a)), RING))  # the head stops at the ring
            yield entities.edge(i, j), rr.Arrows2D(origins=[a], vectors=[along], radii=[EDGE], draw_order=0.0)
    for i in entities.ids:
        yield entities.ring(i), rr.Points2D([at[i]], radii=[RING], draw_order=1.0)
        colours = np.array([entities.colours[i]], dtype=np.uint32)
        yield entities.point(i), rr.Points2D([at[i]], radii=[NODE], colors=colours, draw_order=2.0)
    if len(at) <= NAMED:
        below = [(x, y + RING) for x, y in at.values()]
        names = [f"node {i}" if len(at) <= WORDS else str(i) for i in at]
        white = np.full(len(at), LABEL, dtype=np.uint32)
        yield "/mesh/names", rr.Points2D(below, radii=[0.001], colors=white, labels=names, show_labels=True)


def _overview(entities: Entities) -> rrb.Container:
    errors = _plot(
        DISTANCE if entities.spec.outside else "Estimation error: log10 ‖x̂ − x‖",
        [entities.error(i) for i in entities.ids],
        legend=len(entities.ids) <= LEGEND,
    )
    lanes = [rrb.StateTimelineView(origin="/alive", name="Processes", time_view=_whole_run())]
    if entities.spec.flags:
        lanes.append(rrb.StateTimelineView(origin="/flag", name="Each node about its estimate", time_view=_whole_run()))
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    log = rrb.TextLogView(origin=EVENTS, name="Events", columns=columns)
    return rrb.Horizontal(
        rrb.Vertical(errors, *lanes, row_shares=[6, 5, 4] if entities.spec.flags else [3, 2]),
        rrb.Vertical(_topology(entities), log, row_shares=[3, 2]),
        column_shares=[5, 3],
        name="Overview",
    )


def _topology(entities: Entities) -> rrb.View:
    points = np.array(list(positions(entities.ids, entities.spec.arcs).values()))
    low, high = points.min(axis=0) - 0.7, points.max(axis=0) + 0.7
    return rrb.Spatial2DView(
        origin="/mesh",
        name="Topology (green up, amber late, red down)",
        visual_bounds=rrb.VisualBounds2D(x_range=[low[0], high[0]], y_range=[low[1], high[1]]),
    )


def _estimates(entities: Entities, worst: Sequence[int]) -> rrb.Container:
    """One tab with all nodes, and one per node; a view per state. Of many nodes the worst, and their errors first."""
    states = spread(entities.shown, VIEWS)
    chosen = tuple(worst) or spread(entities.ids, LINES)
    name = "All nodes" if len(chosen) == len(entities.ids) else f"{len(chosen)} nodes"
    errors = []
    if worst:
        name = f"The {len(chosen)} worst nodes"
        errors.append(
            _plot(f"{name}: log10 ‖x̂ − x‖", [entities.error(i) for i in chosen], legend=len(chosen) <= LEGEND)
        )

    def grid(nodes: Iterable[int], name: str) -> rrb.Container:
        views = list(errors)
        for c in states:
            paths = [f"{entities.state(c)}/actual", *(f"{entities.state(c)}/{entities.name(i)}" for i in nodes)]
            views.append(_plot(f"x{c + 1}", paths, legend=c == states[0] and len(paths) <= LEGEND))
        return rrb.Grid(*views, name=name)

    return rrb.Tabs(
        grid(chosen, name),
        *(grid([i], f"Node {i}") for i in chosen if len(entities.ids) > 1),
        active_tab=0,
        name="Estimates",
    )


def _reconstruction(entities: Entities) -> list[rrb.Container]:
    """What a method estimates beside the state, where it does."""
    inputs = [
        _plot(f"Unknown input w{j + 1}, estimated", [f"/unknown_input/w{j + 1}/**"], legend=len(entities.ids) <= LEGEND)
        for j in range(entities.spec.unknown_inputs)
    ]
    noises = [
        _plot(f"Measurement noise of node {i}, estimated", [f"/noise/{entities.name(i)}/**"], legend=True)
        for i in spread(entities.ids, LINES)
        if any(path.startswith("/noise") for _, path in entities.estimates(i))
    ]
    views = inputs[:VIEWS] + noises
    return [rrb.Grid(*views, name="Reconstruction")] if views else []


def _rounds(entities: Entities) -> list[rrb.Container]:
    """The rounds of the step that is watched, if one is."""
    if (k := entities.spec.watch_step) is None:
        return []
    names = {
        "residual": f"Step {k}, round by round: log10 ‖Tᵢ xᵢ − ξᵢ‖, from its own equations",
        "disagreement": f"Step {k}, round by round: log10 of the largest ‖xᵢ − xⱼ‖, from its neighbours",
    }
    few = len(entities.ids) <= LEGEND
    begin, end = (rr.TimeRangeBoundary.absolute(seconds=at * entities.spec.step) for at in (k, k + 1))
    axis = rrb.TimeAxis(view_range=rr.TimeRange(start=begin, end=end))  # the rounds are spread over their step
    views = [
        _plot(name, [entities.rounds(kind, i) for i in entities.ids], legend=few, axis=axis)
        for kind, name in names.items()
    ]
    return [rrb.Vertical(*views, name="Rounds")]


def _run(entities: Entities, rates: bool) -> rrb.Container:
    document = rrb.TextDocumentView(origin=DESCRIPTION, name="What was run")
    legend = len(entities.ids) < LEGEND
    plots = [_plot("Steps per second", [f"{RATES}/**"], legend=legend)] if rates else []
    if entities.spec.tick:
        plots.append(_plot("Neighbours that a node went on without", [f"{GAPS}/**"], legend=legend))
    return rrb.Horizontal(*([rrb.Vertical(*plots)] if plots else []), document, name="Run")


def _plot(name: str, contents: list[str], *, legend: bool, axis: rrb.TimeAxis | None = None) -> rrb.View:
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=name,
        axis_x=axis or _whole_run(),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
        interaction=rrb.PlotInteraction(tooltip_mode=rrb.components.TooltipMode.All),
    )


def _whole_run() -> rrb.TimeAxis:
    """From the first to the last row. (Linked axes would start with the last minute before the cursor.)"""
    ends = rr.TimeRangeBoundary.infinite()
    return rrb.TimeAxis(view_range=rr.TimeRange(start=ends, end=ends))
