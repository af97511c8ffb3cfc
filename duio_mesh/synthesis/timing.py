"""A design for the wall clock: the same gains, and what plant and nodes have to know of time."""

from __future__ import annotations

from dataclasses import replace

from duio_mesh.synthesis.design import Design


def on_the_clock(design: Design) -> Design:
    """The design with its scenario's timing.

    Samples travel one by one, and every step is reported. A deadline counts from when something is due, a tick later.
    """
    scenario = design.scenario
    timing = scenario.timing
    if not timing.tick:
        return design
    deadline = scenario.run.deadline + timing.tick
    nodes = {
        i: replace(
            spec,
            tick=timing.tick,
            wait=timing.wait,
            deadline=deadline,
            block=1,
            credit=1,
        )
        for i, spec in design.nodes.items()
    }
    plant = replace(design.plant, tick=timing.tick, wait=timing.wait, deadline=deadline, block=1)
    return replace(design, plant=plant, nodes=nodes)
