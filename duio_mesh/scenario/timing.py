"""When steps happen: as fast as the slowest node (lockstep), or on the wall clock (realtime)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from duio_mesh.scenario import model, schema
from duio_mesh.scenario.problems import Path, Problems
from duio_mesh.scenario.validate import fields

TIMING: Path = ("timing",)
WAIT = 0.5  # of a tick, when the file does not say


def read_timing(
    document: Mapping[str, Any], plant: model.Plant | None, run: Mapping[str, Any], problems: Problems
) -> model.Timing:
    """The timing; a tick that is not given is the plant's own seconds per sample."""
    if document.get("timing") is None:
        return model.LOCKSTEP
    written = fields(schema.Timed, {"timing": document["timing"]}, (), problems).get("timing", "lockstep")
    timing = written if isinstance(written, schema.Timing) else schema.Timing(mode=written)
    if timing.mode == "lockstep":
        return model.LOCKSTEP
    if run.get("batch", 1) > 1:
        problems.at(
            ("run", "batch"),
            f"should be 1 under timing: realtime, not {run['batch']}: every tick has its own estimate, and a batch "
            "would hold it back",
        )
    if run.get("on_node_loss") == "restart":
        problems.at(
            ("run", "on_node_loss"),
            "cannot be restart under timing: realtime: who comes back joins at an agreed step, for which the others "
            "would have to wait; choose stop or degrade",
        )
    tick = timing.tick
    if tick is None and plant is not None:
        tick = plant.step
        if not schema.LEAST_TICK <= tick <= schema.MOST_TICK:
            problems.at(
                TIMING,
                f"the plant's own {tick:g} s per sample are no tick for a wall clock; say how many seconds a step may "
                f"take, {schema.LEAST_TICK:g} to {schema.MOST_TICK:g}: {{mode: realtime, tick: 0.02}}",
            )
    wait = WAIT if timing.wait is None else timing.wait
    return model.Timing("realtime", tick or schema.LEAST_TICK, wait * (tick or schema.LEAST_TICK))
