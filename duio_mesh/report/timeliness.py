"""What a run on the wall clock says of its time: who was late, and how much of what was sent came in time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from duio_mesh.scenario.model import Scenario, Timing

NOTICEABLE = 0.01  # of the messages, or of the steps
FEW = 4  # nodes that are named


def timeliness(scenario: Scenario, said: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The entry ``timing`` of metrics.json; ``said`` is what each process (plant, node-3) reported at its end.

    A process that was lost has no figures.
    """
    found = {who: dict(done["timing"]) for who, done in said.items() if done.get("timing")}
    timing = scenario.timing
    return {
        "mode": timing.mode,
        "tick": timing.tick,
        "wait": timing.wait,
        "plant": found.pop("plant", {}),
        "nodes": {who.removeprefix("node-"): figures for who, figures in found.items()},
    }


def untimely(timing: Mapping[str, Any], steps: int) -> list[str]:
    """Warnings: a noticeable part of the messages was not there in time, or of the steps was late."""
    found = []
    plant, nodes = timing["plant"], timing["nodes"]
    if plant.get("late_ticks", 0) > NOTICEABLE * steps or plant.get("worst_lateness", 0) > timing["tick"]:
        behind = f"; {', '.join(plant['behind'])} kept it waiting" if plant["behind"] else ""
        found.append(
            f"plant: {plant['late_ticks']} of {steps} ticks began late, by {plant['worst_lateness']:.3g} s at worst"
            f"{behind}"
        )
    absent = {i: 1 - f["on_time"] / max(1, f["on_time"] + f["late"] + f["missing"]) for i, f in nodes.items()}
    worst = sorted((i for i in nodes if absent[i] > NOTICEABLE), key=lambda i: -absent[i])
    for i in worst[:FEW]:
        found.append(
            f"node-{i} went on without {absent[i]:.0%} of its neighbours' messages: {nodes[i]['late']} came late, "
            f"{nodes[i]['missing']} not at all"
        )
    if len(worst) > FEW:
        found.append(f"and so did {len(worst) - FEW} more nodes, without {absent[worst[FEW]]:.0%} or less")
    slow = {i: f["overruns"] for i, f in nodes.items() if f["overruns"] > NOTICEABLE * steps}
    if slow:
        who = max(slow, key=slow.__getitem__)
        others = f", and so did {len(slow) - 1} more" if len(slow) > 1 else ""
        found.append(f"node-{who} needed more than a tick for {slow[who]} of {steps} steps{others}")
    return found


def in_words(timing: Timing, steps: int, *, processes: bool) -> str:
    """What a run on the wall clock is about to do; "" in lockstep."""
    if timing.mode == "lockstep":
        return ""
    if not processes:
        return "timing: realtime in one process is the ideal network: in lockstep, nothing late, nothing missing"
    return f"realtime: {steps} ticks of {timing.tick:g} s, about {_duration(steps * timing.tick)} in all"


def _duration(seconds: float) -> str:
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"
