"""The life of the recorder process: what plant and nodes publish, into a Rerun recording.

It dials everybody and nobody waits for it. What it missed (it came late, was slow, or a batch was dropped) it reads
from the processes' own journals at the end, so a finished recording is complete.
"""

from __future__ import annotations

import ctypes
import os
import signal
import time
from contextlib import nullcontext, suppress
from queue import Empty, SimpleQueue

# Before rerun is imported: what its allocator (mimalloc) has taken for a send goes back to the system when the send is
# done, not when one of its threads happens to look. Without, a long run goes up and down by a tenth of its memory.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")

from duio_mesh.journal import ASIDE, MISSING, PERIOD, aside, map_rows, missing
from duio_mesh.ledger import Ledger
from duio_mesh.mesh import Frame, Mesh, Source
from duio_mesh.observers.watch import COLUMNS
from duio_mesh.process import Report, main
from duio_mesh.report.recording import Recording
from duio_mesh.spec import RecorderSpec

_M_MMAP_THRESHOLD, LARGE = -3, 1 << 17  # malloc.h; bytes from which a block is a mapping of its own

RATE_PERIOD = 0.5  # seconds between two values of the rates at first, and between writes that nobody watches
RATES = 128  # values after which the rates are said half as often: a long run shall not fill memory with them


class Rates:
    """Steps per second of plant and nodes, from how far they have come."""

    def __init__(self, recording: Recording) -> None:
        self._recording, self._at, self._seen = recording, time.monotonic(), dict[str, int]()
        self._period, self._said = RATE_PERIOD, 0

    def look(self, newest: dict[str, int]) -> None:
        """Log the rates once in a while."""
        now = time.monotonic()
        if (passed := now - self._at) < self._period:
            return
        self._said += 1
        if self._said % RATES == 0:
            self._period *= 2
        rates = {who: (k - self._seen.get(who, 0)) / passed for who, k in newest.items()}
        self._recording.rates(max(0, max(newest.values()) - 1), rates)
        self._at, self._seen = now, dict(newest)


def run(spec: RecorderSpec, report: Report) -> None:
    """Record until SIGTERM (with ``kept`` also until nobody is left), then complete and close the recording."""
    with suppress(AttributeError):  # another C library than glibc, which raises this limit as soon as a larger block is
        ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE)  # freed; later ones lie in the heap and do not go back
    finishing = SimpleQueue[None]()
    changes = SimpleQueue[tuple[str, bool]]()
    writing = Ledger(spec) if spec.kept else nullcontext()
    with writing as ledger, Recording(spec) as recording, Mesh(spec.wire, "recorder", report.warn) as mesh:

        def finish(*_: object) -> None:
            finishing.put(None)
            mesh.wake()

        signal.signal(signal.SIGTERM, finish)
        report.last = lambda: {"rejected": mesh.rejections()}
        keys = mesh.keys
        node_of: dict[Source, int | None] = {}
        for i in spec.sizes:
            ready = (i, "recorder") if spec.kept else None  # then the node waits for us
            node_of[mesh.hear(keys.trace(i), f"{i} -> recorder", f"node-{i}", ready)] = i
        # last, because the plant starts when it sees this one
        node_of[mesh.hear(keys.truth(), "plant -> recorder", "plant", ("plant", "recorder"))] = None
        mesh.watch(lambda member, alive: changes.put((member.who, alive)))
        report("ready", url=recording.url)
        newest = {"plant": 0} | {f"node-{i}": 0 for i in spec.sizes}
        pause = PERIOD if spec.live else RATE_PERIOD
        rates, due = Rates(recording), time.monotonic() + pause
        while (finishing.empty() and not (ledger and ledger.over())) or mesh.pending():
            with suppress(Empty):
                if got := mesh.get(PERIOD):
                    source, frame = got
                    if not _fits(spec, node_of[source], frame):
                        mesh.reject(source, "no rows of this run")
                        continue
                    if ledger:
                        ledger.take(source.who, frame)
                    newest[source.who] = max(newest[source.who], _keep(recording, spec, node_of[source], frame))
            while not changes.empty():
                who, alive = changes.get()
                if ledger:
                    ledger.changed(who, alive)
                if who in newest:
                    recording.liveness(who, "up" if alive else "down", max(0, newest[who] - 1))
            if time.monotonic() >= due:
                rates.look(newest)
                recording.flush()
                due = time.monotonic() + pause
        recording.fill(
            map_rows(spec.truth, spec.n), {i: map_rows(path, spec.sizes[i]) for i, path in spec.estimates.items()}
        )
        for i, path in spec.estimates.items():
            recording.rounds(i, map_rows(aside(path), COLUMNS))
            recording.missing_neighbours(i, 0, map_rows(missing(path), 1)[:, 0])
        for who, lack in ledger.missing().items() if ledger else ():
            report.warn(f"{lack} of the {spec.steps} rows of {who} did not come")
    report("done", cpu_seconds=time.process_time(), rejected=mesh.rejections())


def _fits(spec: RecorderSpec, node: int | None, frame: Frame) -> bool:
    """Whether these are whole rows of steps that the run has."""
    if node is not None and frame.r == ASIDE:  # rows of one step
        return frame.vector.size % COLUMNS == 0 and frame.k < spec.steps
    size = spec.n if node is None else 1 if frame.r == MISSING else spec.sizes[node]
    count, rest = divmod(frame.vector.size, size)
    return not rest and frame.k + count <= spec.steps


def _keep(recording: Recording, spec: RecorderSpec, node: int | None, frame: Frame) -> int:
    """Hand one batch to the recording; the step after its last row."""
    if node is not None and frame.r == ASIDE:
        recording.rounds(node, frame.vector.reshape(-1, COLUMNS))
        return frame.k
    if node is not None and frame.r == MISSING:
        recording.missing_neighbours(node, frame.k, frame.vector)
        return frame.k
    rows = frame.vector.reshape(-1, spec.n if node is None else spec.sizes[node])
    if node is None:
        recording.truth(frame.k, rows)
    else:
        recording.estimates(node, frame.k, rows)
    return frame.k + len(rows)


if __name__ == "__main__":
    main(RecorderSpec, run)
