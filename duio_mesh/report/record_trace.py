"""A finished run as a recording: for runs in one process, and where a run's recorder was lost."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from duio_mesh.report.pairing import runs
from duio_mesh.report.recording import Recording
from duio_mesh.scenario.model import Scenario
from duio_mesh.spec import RecorderSpec
from duio_mesh.trace import Trace


def record_trace(path: Path, scenario: Scenario, trace: Trace, description: str = "") -> None:
    """Write a finished run as ``path``, whole or not at all: the same recording without rates.

    ``description``: markdown, by default the scenario's. Raises OSError when the file cannot be written.
    """
    q = 0 if trace.what is None else trace.what.shape[2]
    rows = {}
    for at, i in enumerate(trace.node_ids.tolist()):
        parts = [trace.xhat[at], trace.what[at] if trace.what is not None else None, trace.vhat.get(i)]
        parts += [trace.flagged[at, :, None]] if trace.flagged is not None else []
        rows[i] = np.hstack([part for part in parts if part is not None])
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    spec = RecorderSpec(
        name=scenario.name,
        n=scenario.plant.n,
        sizes={i: r.shape[1] for i, r in rows.items()},
        arcs=tuple((arc.source, arc.target) for arc in scenario.graph.arcs),
        step=scenario.plant.step,
        steps=len(trace.t),
        recording=str(temporary),
        live=False,
        description=description or scenario.description,
        truth="",
        estimates={},
        unknown_inputs=q,
        flags=trace.flagged is not None,
        watch_step=getattr(scenario.options, "watch_step", None),
        tick=scenario.timing.tick if trace.missing else 0.0,
        outside=scenario.outside is not None,
    )
    try:
        with Recording(spec, rates=False) as recording:
            _outline(recording, trace)
            recording.fill(trace.x, rows)
            for i, figures in trace.rounds.items():
                recording.rounds(i, figures)
            for i, counts in trace.missing.items():
                recording.missing_neighbours(i, 0, counts)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _outline(recording: Recording, trace: Trace) -> None:
    """Who wrote rows from the first step on, who stopped before the last, and who came back."""
    written = {"plant": trace.x} | {f"node-{i}": trace.xhat[at] for at, i in enumerate(trace.node_ids.tolist())}
    changes = [(0, who, "up") for who in written]
    for who, rows in written.items():
        for first, after in runs(np.flatnonzero(np.isnan(rows).all(axis=1))):
            changes += [(first, who, "down")] + ([(after, who, "up")] if after < len(rows) else [])
    for k, who, state in sorted(changes, key=lambda change: change[0]):  # an edge is as its ends are at that time
        recording.liveness(who, state, k)
