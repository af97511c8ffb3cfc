"""Watches the processes of one run through their nursery, and ends them: no death goes unnoticed, no process is left.

It waits only on file descriptors with timeouts: what the processes report, what the nursery says of their deaths, and
how far their journals have grown.
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from duio_mesh.errors import RunError
from duio_mesh.spec import START

FRAME = 0.1  # seconds between looks at the progress
PATIENCE = 2.0  # seconds beyond the deadline that a process has for saying itself what it waited for
GATHER = 0.3  # seconds after the first failure in which others may say what they saw
END = 2.0  # seconds for asked processes to end before they are made to
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


class Process:
    """What is known of one process."""

    def __init__(self, who: str) -> None:
        self.who = who
        self.said: dict[str, Any] = {}  # what it reported when it was ready
        self.done: dict[str, Any] = {}  # its last words when all went well
        self.failure = ""  # what it says went wrong
        self.code: int | None = None  # exit code; negative is a signal
        self.warnings: list[str] = []

    @property
    def essential(self) -> bool:
        """A run does without its recorder."""
        return self.who != "recorder"

    def death(self) -> str:
        """How it ended, in words."""
        if self.code is not None and self.code < 0:
            return f"{self.who} was killed by {signal.Signals(-self.code).name}"
        return self.failure or f"{self.who} ended with exit code {self.code}"


class Supervisor:
    """The launcher's end of a nursery; a context manager that leaves no process behind."""

    def __init__(self) -> None:
        """Start the nursery; it gets ready by itself while the caller goes on."""
        self.processes: dict[str, Process] = {}
        self.note = ""  # what a gateway waits for
        self._beats = 0  # whatever anybody says shows that things move
        self._status, write = os.pipe()
        self._control, theirs = socket.socketpair()
        environment = os.environ | dict.fromkeys(THREADS, "1")
        self._nursery = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            [sys.executable, "-m", "duio_mesh.nursery", str(theirs.fileno()), str(write)],
            pass_fds=(theirs.fileno(), write),
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C in the terminal is the launcher's alone
            env=environment,
        )
        theirs.close()
        os.close(write)
        self._text: dict[int, bytes] = {self._status: b"", self._control.fileno(): b""}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Close our end: the nursery ends whoever is left, then itself."""
        self._control.close()
        os.close(self._status)
        try:
            self._nursery.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._nursery.kill()  # its children die with it
            self._nursery.wait()

    def prepare(self, who: str) -> None:
        """Let a process that takes long to import get ready before there is anything to give it."""
        self.processes[who] = Process(who)
        self._order({"prepare": who, "who": who})

    def start(self, who: str, kind: str, spec: Path, log: Path, errors: Path) -> None:
        """Start one process."""
        self.processes.setdefault(who, Process(who))
        self._order({"start": kind, "who": who, "spec": str(spec), "log": str(log), "errors": str(errors)})

    def kill(self, who: str, number: int) -> None:
        """Send a signal to one process."""
        self._order({"who": who, "signal": number})

    def watch(self, look: Callable[[], int], deadline: float) -> None:
        """Until plant and nodes are done, or one of them is not well.

        ``look`` is called ten times a second, shows the progress and returns a number that grows with it.
        Raises RunError naming the process, or the edge, step and round that a process reported.
        """
        seen, since = (-1, 0), time.monotonic()
        while not all(p.code == 0 for p in self._essential()):
            self._listen(FRAME)
            if any(p.failure or p.code for p in self._essential()):
                self._until(lambda: False, GATHER)
                raise RunError(self._diagnosis())
            if (now := (look(), self._beats)) != seen:
                seen, since = now, time.monotonic()
            elif time.monotonic() - since > self._allowed(deadline):
                stuck = ", ".join(p.who for p in self._essential() if not p.done)
                raise RunError(f"nothing has moved for {time.monotonic() - since:.1f} s; not finished: {stuck}")
        look()

    def finish(self, who: str, timeout: float) -> bool:
        """Ask a process to finish and wait for its end; whether it ended well."""
        process = self.processes[who]
        if process.code is None:
            self.kill(who, signal.SIGTERM)
            self._until(lambda: process.code is not None, timeout)
        return bool(process.done) and process.code is not None

    def end(self) -> None:
        """Ask all processes to stop, then make them."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            for p in self.processes.values():
                if p.code is None:
                    self.kill(p.who, number)
            self._until(lambda: all(p.code is not None for p in self.processes.values()), END)

    def _allowed(self, deadline: float) -> float:
        started = all(p.said for p in self._essential())
        return (deadline if started else START) + PATIENCE

    def _essential(self) -> list[Process]:
        return [p for p in self.processes.values() if p.essential]

    def _diagnosis(self) -> str:
        """Who was the first cause: a killed process before one that failed by itself, before one that lost a peer."""
        killed = [p.death() for p in self._essential() if p.code and p.code < 0]
        failed = [p.failure for p in self._essential() if p.failure]
        return "; ".join(killed + failed) or "; ".join(p.death() for p in self._essential() if p.code)

    def _until(self, done: Callable[[], bool], timeout: float) -> None:
        end = time.monotonic() + timeout
        while not done() and (left := end - time.monotonic()) > 0:
            self._listen(left)

    def _order(self, order: dict[str, Any]) -> None:
        try:
            self._control.sendall(json.dumps(order).encode() + b"\n")
        except (BrokenPipeError, ConnectionResetError):
            raise RunError("the nursery process, which starts and watches the others, has died") from None

    def _listen(self, timeout: float) -> None:
        """Take in what has been said within ``timeout`` seconds, returning at the first news."""
        ready, _, _ = select.select(list(self._text), [], [], timeout)
        for fd in ready:
            data = os.read(fd, 1 << 16)
            if not data and fd == self._control.fileno():
                raise RunError("the nursery process, which starts and watches the others, has died")
            if not data:
                del self._text[fd]
                continue
            *lines, self._text[fd] = (self._text[fd] + data).split(b"\n")
            for line in lines:
                self._hear(json.loads(line))

    def _hear(self, event: dict[str, Any]) -> None:
        process, what = self.processes[event["who"]], event["event"]
        self._beats += 1
        if what == "ready":
            process.said = event
        elif what == "done":
            process.done = event
        elif what == "failed":
            process.failure = event["text"]
        elif what == "sensors":
            self.note = event["text"]
        elif what == "warning":
            process.warnings.append(event["text"])
        elif what == "exit":
            process.code = event["code"]
