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
from typing import Any, Self, TypeAlias

from duio_mesh import diagnosis
from duio_mesh.account import Account
from duio_mesh.diagnosis import Process
from duio_mesh.errors import RunError
from duio_mesh.spec import PATIENCE, START

FRAME = 0.1  # seconds between looks at the progress ...
SHARE, SELDOM = 0.02, 1.0  # ... or more, so that they take only this part of the time; but at least so often
MARGIN = 2.0  # seconds beyond the deadline that a process has for saying itself what it waited for
GATHER = 0.3  # seconds after the first failure in which others may say what they saw
END = 2.0  # seconds for asked processes to end before they are made to
LONGER = PATIENCE + 1  # deadlines, where lost nodes are survived: their own waits may last PATIENCE of them
HERE = str(Path(__file__).parent.parent)
# -P: nothing in the present folder is imported; this package is found where it is, installed or not
NURSERY = "import sys; sys.path.append(sys.argv.pop()); from duio_mesh.nursery import main; main()"
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")

Recover: TypeAlias = Callable[[Process], bool] | None


class Supervisor(Account):
    """The launcher's end of a nursery; a context manager that leaves no process behind."""

    def __init__(self) -> None:
        """Start the nursery; it gets ready by itself while the caller goes on."""
        super().__init__()
        self._status, write = os.pipe()
        self._control, theirs = socket.socketpair()
        environment = os.environ | dict.fromkeys(THREADS, "1")
        self._nursery = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            [sys.executable, "-P", "-c", NURSERY, str(theirs.fileno()), str(write), HERE],
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

    def replace(self, who: str, kind: str, spec: Path, log: Path, errors: Path) -> None:
        """Start another process in place of one that has ended."""
        before = self.processes[who]
        fresh = self.processes[who] = Process(who)
        fresh.before, fresh.warnings = before.before + 1, before.warnings
        self.start(who, kind, spec, log, errors)

    def forget(self, secrets: Path) -> None:
        """Have this folder removed when everybody has ended, even if this process does not live to see it."""
        self._order({"secrets": str(secrets)})

    def kill(self, who: str, number: int) -> None:
        """Send a signal to one process."""
        self._order({"who": who, "signal": number})

    def watch(
        self, look: Callable[[], int], deadline: float, recover: Recover = None, limit: float | None = None
    ) -> None:
        """Until plant and nodes are done, or one of them is not well and ``recover`` does not know what to do about it.

        ``look`` shows the progress and returns a number that grows with it; it is called ten times a second, less often
        where it takes long because there is much to look at.
        ``recover(process)`` is called with one that has ended without being done; whether the run goes on. ``limit``:
        seconds for everything.
        Raises RunError naming the process, or the edge, step and round that a process reported.
        """
        begin = since = next_look = time.monotonic()
        seen, grown = (-1, 0), -1
        while not all(p.code == 0 for p in self._essential()):
            self._until(lambda: self.news, FRAME)
            self.news = False
            self._wake()
            for p in self._essential():
                if p.code and recover and recover(p):
                    since = time.monotonic()
            if any(p.code or (p.failure and not self._recovers(p, recover)) for p in self._essential()):
                self._until(lambda: False, GATHER)
                self._until(lambda: not diagnosis.owing(self.processes), END)
                raise RunError(diagnosis.first_cause(self.processes))
            if self.source_done():
                self._end_the_late()
            now = time.monotonic()
            if limit is not None and now - begin > limit:
                raise RunError(f"the run took longer than run.max_seconds = {limit:g} s{self._who_waits()}")
            if now >= next_look:
                grown = look()
                next_look = now + min(SELDOM, max(FRAME, (time.monotonic() - now) / SHARE))
            if (news := (grown, self.words)) != seen:
                seen, since = news, now
            if recover:
                self._end_the_stuck(deadline)
            if self._stuck(now - since, deadline, LONGER if recover else 1):
                stuck = ", ".join(p.who for p in self._essential() if not p.done)
                raise RunError(f"nothing has moved for {now - since:.1f} s; not finished: {stuck}{self._who_waits()}")
        look()

    @staticmethod
    def _recovers(process: Process, recover: Recover) -> bool:
        """Whether its failure may be survived, once it has ended."""
        return recover is not None and process.who.startswith("node-")

    def source_done(self) -> bool:
        """Whether plant or gateway have sent their last sample and seen every node finish."""
        return any(self.processes[who].code == 0 for who in ("plant", "gateway") if who in self.processes)

    def all_ready(self, timeout: float) -> bool:
        """Whether everybody but the recorder has said that it is ready, or does so within ``timeout`` seconds."""
        needed = [p for p in self.processes.values() if p.essential]
        self._until(lambda: all(p.said for p in needed), timeout)
        return all(p.said for p in needed)

    def _end_the_late(self) -> None:
        """The plant is done, so whoever is not back in step has come too late."""
        for p in self._essential():
            if p.before and not p.back and p.code is None:
                p.there = False
                p.warnings.append("the run was over before it was back in step")
                self.kill(p.who, signal.SIGKILL)

    def _who_waits(self) -> str:
        words = [self.waiting(), *diagnosis.stopped(self.processes, but=diagnosis.roots(self.processes))]
        return f" ({'; '.join(filter(None, words))})" if any(words) else ""

    def _end_the_stuck(self, deadline: float) -> None:
        """Kill who has kept the others waiting for longer than the deadline: then it is lost, for certain."""
        for p, others in diagnosis.culprits(self.processes, deadline, time.monotonic()):
            p.warnings.append(f"kept {diagnosis.some(others)} waiting for {deadline:g} s; killed")
            self.kill(p.who, signal.SIGKILL)

    def _wake(self) -> None:
        """Continue those that were stopped on purpose, until they say that they have felt it."""
        for p in self.processes.values():
            if p.wakes is not None and p.code is None and time.monotonic() >= p.wakes:
                self.kill(p.who, signal.SIGCONT)

    def finish(self, who: str, timeout: float) -> bool:
        """Ask a process to finish and wait for its end, unless it is stopped; whether it ended well."""
        process = self.processes[who]
        if process.code is None:
            self.kill(who, signal.SIGTERM)
            end = time.monotonic() + timeout
            while process.code is None and time.monotonic() < end and not process.stopped():
                self._until(lambda: process.code is not None, FRAME)
        return bool(process.done) and process.code is not None

    def end(self) -> None:
        """Ask all processes to stop, then make them."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            for p in self.processes.values():
                if p.code is None:  # a recorder that has not begun has nothing to finish, and looks for the others
                    self.kill(p.who, number if p.said or p.essential else signal.SIGKILL)
            self._until(lambda: all(p.code is not None for p in self.processes.values()), END)

    def _stuck(self, still: float, deadline: float, times: int) -> bool:
        """Whether so many seconds without news are too many; a start may take longer, unless somebody is stopped."""
        if still <= (deadline + MARGIN) * times:
            return False
        started = all(p.said for p in self._essential()) or diagnosis.stopped(self.processes)
        return bool(started) or still > (START + MARGIN) * times

    def _essential(self) -> list[Process]:
        return diagnosis.essential(self.processes)

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
        """Take in what has been said within ``timeout`` seconds, returning at the first news.

        Who is said to have ended has said its last words before that: they are heard as well.
        """
        ready, _, _ = select.select(list(self._text), [], [], timeout)
        for fd in ready:
            self._read(fd)
        if self._control.fileno() in ready:
            while self._status in self._text and select.select([self._status], [], [], 0)[0]:
                self._read(self._status)

    def _read(self, fd: int) -> None:
        try:
            data = os.read(fd, 1 << 16)
        except ConnectionResetError:  # it was killed before it had read what we told it
            data = b""
        if not data and fd == self._control.fileno():
            raise RunError("the nursery process, which starts and watches the others, has died")
        if not data:
            del self._text[fd]
            return
        *lines, self._text[fd] = (self._text[fd] + data).split(b"\n")
        for line in lines:
            self.hear(json.loads(line))
