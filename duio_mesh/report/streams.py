"""The two ends of a recording: the file, which gets everything, and the live server, which gets what it can take.

They are two Rerun streams with one recording id, because a stream with two sinks stalls when a viewer is frozen: then
the file would stop too.

Nothing leaves the host. Rerun's usage statistics belong to its viewer and its command line; the library, used as it is
here (file sink, server sink, reader), neither opens a connection nor touches a configuration file.
"""

from __future__ import annotations

import atexit
import os
import socket
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any, NamedTuple
from uuid import uuid4

import numpy as np
import rerun as rr
from numpy.typing import NDArray

LOOPBACK = "127.0.0.1"
WRITE = 60.0  # seconds that the disk may take for what is still to be written
ABANDON = 60.0  # seconds that the end of this process may be held up by a viewer that is frozen
LINGER = 2.0  # seconds that a viewer has at the end for what it has not read yet
QUEUE = 2048  # batches that wait for the live server; further ones are dropped
HISTORY = "256MiB"  # what the live server keeps for a viewer that comes late
PORTS = 8  # attempts at a free port: between choosing one and listening, somebody else may take it


class Batch(NamedTuple):
    """Rows of one entity."""

    path: str
    steps: NDArray[np.int64]  # (m,)
    columns: Any  # Rerun's component columns with m rows
    rounds: NDArray[np.int64] | None = None  # (m,) within one step, ascending: they are spread over its time


@dataclass(frozen=True)
class Opening:
    """What both streams start with."""

    name: str  # of the run
    step: float  # seconds between samples
    blueprint: Any
    styles: Iterable[tuple[str, Any]]  # (entity path, archetype) that hold at all times
    recording_id: str

    @classmethod
    def of(cls, name: str, step: float, blueprint: Any, styles: Iterable[tuple[str, Any]]) -> Opening:
        """An opening with an id of its own: the viewer would melt two recordings with the same id into one."""
        return cls(name, step, blueprint, list(styles), uuid4().hex)

    def stream(self) -> rr.RecordingStream:
        """A stream without a sink. Raises ValueError when the environment turns Rerun off."""
        if os.environ.get("RERUN", "on").lower() in ("0", "off", "false", "no"):
            raise ValueError(f"the environment says RERUN={os.environ['RERUN']}: nothing can be recorded; unset it")
        # the viewer keeps one layout per application id: one per run name, so that no run gets another's
        application = "duio_mesh " + "".join(c if c.isascii() and c.isalnum() else "_" for c in self.name)[:160]
        return rr.RecordingStream(application, recording_id=self.recording_id)

    def begin(self, stream: rr.RecordingStream, sink: Any) -> None:
        """Give the stream its sink, the layout and the styles."""
        stream.set_sinks(sink, default_blueprint=self.blueprint)
        stream.send_recording_name(self.name)
        for path, archetype in self.styles:
            stream.log(path, archetype, static=True, strict=True)

    def send(self, stream: rr.RecordingStream, batch: Batch) -> None:
        """Send one batch on both timelines."""
        rounds = batch.rounds
        at = batch.steps if rounds is None else batch.steps + rounds / (rounds[-1] + 1)
        nanoseconds = np.rint(at * (self.step * 1e9)).astype("timedelta64[ns]")
        times = [rr.TimeColumn("sim_time", duration=nanoseconds), rr.TimeColumn("step", sequence=batch.steps)]
        if rounds is not None:
            times.append(rr.TimeColumn("round", sequence=rounds))
        stream.send_columns(batch.path, indexes=times, columns=batch.columns, strict=True)


class FileStream:
    """recording.rrd. A kill loses at most what was sent after the last ``flush``."""

    def __init__(self, path: Path, opening: Opening) -> None:
        """Raises OSError when the file cannot be created."""
        self._path, self._opening = path, opening
        self._unwritten = True
        self._stream = opening.stream()
        try:
            opening.begin(self._stream, rr.FileSink(path))
        except RuntimeError as e:
            raise OSError(f"cannot record to {path}: {e}") from None

    def send(self, batch: Batch) -> None:
        """Pass a batch to the thread that writes."""
        self._unwritten = True
        self._opening.send(self._stream, batch)

    def flush(self) -> None:
        """Wait until everything is with the operating system. Raises OSError when it would not take it."""
        if not self._unwritten:
            return
        try:
            self._stream.flush(timeout_sec=WRITE)
        except RuntimeError as e:
            raise OSError(f"{self._path} is incomplete: {e}") from None
        self._unwritten = False

    def lay_out(self, blueprint: Any) -> None:
        """Replace the layout."""
        self._unwritten = True
        self._stream.send_blueprint(blueprint)

    def close(self) -> None:
        """Write what is left, and the footer. Raises OSError when that is impossible (a full disk)."""
        self.flush()
        self._stream.disconnect()  # not after a failure: it would write once more, and has been seen to hang then


class LiveStream:
    """A server on loopback that a viewer may join, leave or freeze at any time without anybody noticing here."""

    def __init__(self, opening: Opening) -> None:
        """Raises OSError when no port can be had."""
        self._opening = opening
        self.dropped = 0  # batches that no viewer will see
        self._stream, self.url = self._serve()
        self._queue = Queue[Batch | None](QUEUE)
        self._abandoned = False
        self._thread = Thread(target=self._feed, name="live", daemon=True)
        self._thread.start()

    def send(self, batch: Batch) -> None:
        """Pass a batch on, or drop it when the queue is full; never waits."""
        try:
            self._queue.put_nowait(batch)
        except Full:
            self.dropped += 1

    def close(self) -> None:
        """End the server, giving a slow viewer ``LINGER`` seconds; one that is frozen is left behind."""
        try:
            self._queue.put_nowait(None)
        except Full:
            self._abandoned = True
        self._thread.join(LINGER)
        if self._thread.is_alive():
            # Rerun gives up on a frozen viewer after about 20 s; a process that ends earlier, other than by os._exit,
            # has to wait for that: its end would catch the thread in Rerun's code and abort
            self._abandoned = True
            atexit.register(self._thread.join, ABANDON)

    def _serve(self) -> tuple[rr.RecordingStream, str]:
        for _ in range(PORTS):
            stream = self._opening.stream()
            sink = rr.GrpcServerSink(LOOPBACK, _free_port(), server_memory_limit=HISTORY)
            self._opening.begin(stream, sink)
            try:
                stream.flush(timeout_sec=LINGER)
            except RuntimeError:  # somebody was faster on that port
                stream.disconnect()
            else:
                return stream, sink.uri
        raise OSError("no port of the loopback could be had for the live server")

    def _feed(self) -> None:
        while (batch := self._queue.get()) is not None and not self._abandoned:
            self._opening.send(self._stream, batch)
        self._stream.disconnect()


def _free_port() -> int:
    with socket.socket() as s:
        s.bind((LOOPBACK, 0))
        return int(s.getsockname()[1])
