"""The life of the recorder process: what plant and nodes publish, into a Rerun recording.

It dials everybody and nobody waits for it. What it missed (it came late, was slow, or a batch was dropped) it reads
from the processes' own journals at the end, so a finished recording is complete.
"""

from __future__ import annotations

import signal
import time
from contextlib import suppress
from queue import Empty, SimpleQueue

from duio_mesh.journal import PERIOD, read_rows
from duio_mesh.mesh import Frame, Mesh, Source
from duio_mesh.process import Report, main
from duio_mesh.report.recording import Recording
from duio_mesh.spec import RecorderSpec


def run(spec: RecorderSpec, report: Report) -> None:
    """Record until SIGTERM, then complete and close the recording."""
    recording = Recording(spec)
    finishing = SimpleQueue[None]()
    changes = SimpleQueue[tuple[str, bool]]()
    with Mesh(spec.wire, "recorder", report.warn) as mesh:

        def finish(*_: object) -> None:
            finishing.put(None)
            mesh.wake()

        signal.signal(signal.SIGTERM, finish)
        keys = mesh.keys
        of: dict[Source, int | None] = {mesh.hear(keys.truth(), "plant -> recorder", "plant"): None}
        for i in spec.sizes:
            of[mesh.hear(keys.trace(i), f"{i} -> recorder", f"node-{i}")] = i
        mesh.watch(lambda who, alive: changes.put((who, alive)))
        report("ready", url=recording.url)
        newest = {"plant": 0} | {f"node-{i}": 0 for i in spec.sizes}
        due = time.monotonic() + PERIOD
        while finishing.empty() or mesh.pending():
            with suppress(Empty):
                if got := mesh.get(PERIOD):
                    source, frame = got
                    newest[source.who] = _keep(recording, spec, of[source], frame)
            while not changes.empty():
                who, alive = changes.get()
                if who in newest:
                    recording.liveness(who, "up" if alive else "down", newest[who])
            if time.monotonic() >= due:
                recording.flush()
                due = time.monotonic() + PERIOD
    _complete(recording, spec)
    recording.close()
    report("done", rejected=mesh.rejections())


def _keep(recording: Recording, spec: RecorderSpec, node: int | None, frame: Frame) -> int:
    """Hand one batch to the recording; the step after its last row."""
    size = spec.n if node is None else spec.sizes[node]
    rows = frame.vector.reshape(-1, size)
    if node is None:
        recording.truth(frame.k, rows)
    else:
        recording.estimates(node, frame.k, rows)
    return frame.k + len(rows)


def _complete(recording: Recording, spec: RecorderSpec) -> None:
    """Read what never arrived from the journals."""
    for node, ranges in recording.missing().items():
        path, size = (spec.truth, spec.n) if node is None else (spec.estimates[node], spec.sizes[node])
        rows = read_rows(path, size)
        for first, last in ranges:
            frame = Frame(first, 0, rows[first:last].ravel())
            if frame.vector.size:
                _keep(recording, spec, node, frame)


if __name__ == "__main__":
    main(RecorderSpec, run)
