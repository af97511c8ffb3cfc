"""Starts, signals and buries the processes of a run: a small, clean parent that never held the launcher's memory.

It has imported numpy, Zenoh and the node's code once, and forks from there: a node starts in milliseconds and shares
those pages. (No Zenoh session is ever open in the nursery: a fork would inherit a dead one.) The launcher speaks to it
over a socket, one JSON line a message. When the launcher goes, however it goes, the nursery ends everybody, and then
removes what the launcher would have removed: the credentials of the run.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import setproctitle

import duio_mesh.gateway
import duio_mesh.node
import duio_mesh.observers
import duio_mesh.plant
from duio_mesh import credentials
from duio_mesh.process import Report, live
from duio_mesh.spec import NodeSpec, PlantSpec, RecorderSpec

GRACE = 3.0  # seconds between asking a process to stop and making it
RECORDER_NICE = 10  # it may take what the mesh leaves of the processor; what it misses it reads at the end
_PR_SET_PDEATHSIG = 1


def _run_recorder(spec: RecorderSpec, report: Report) -> None:
    from duio_mesh import recorder  # imports rerun: 90 MB that the nodes must not share

    os.nice(RECORDER_NICE)
    recorder.run(spec, report)


KINDS: dict[str, tuple[Any, Any]] = {
    "node": (NodeSpec, duio_mesh.node.run),
    "plant": (PlantSpec, duio_mesh.plant.run),
    "gateway": (PlantSpec, duio_mesh.gateway.run),
    "recorder": (RecorderSpec, _run_recorder),
}


class Nursery:
    """The processes of one run, from the inside of their parent."""

    def __init__(self, control: socket.socket, status: int) -> None:
        self._control, self._status = control, status
        self._children: dict[int, str] = {}  # pid -> who
        self._prepared: dict[str, int] = {}  # who -> pipe on which it waits for its order
        self._secrets: list[Path] = []  # folders that nobody needs when everybody has ended

    def serve(self) -> None:
        """Obey the launcher until it closes its end; then end what still runs."""
        wake_read, wake_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(wake_write)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        text = b""
        while True:
            waiting: list[Any] = [self._control, wake_read]
            ready, _, _ = select.select(waiting, [], [])
            if wake_read in ready:
                with contextlib.suppress(BlockingIOError):
                    os.read(wake_read, 4096)
                self._bury()
            if self._control in ready:
                try:
                    data = self._control.recv(65536)
                except ConnectionResetError:  # it was killed before it had read what we told it
                    data = b""
                if not data:
                    break
                *lines, text = (text + data).split(b"\n")
                for line in lines:
                    self._obey(json.loads(line))
        self._end_all(wake_read)
        for folder in self._secrets:
            credentials.remove(folder)

    def _obey(self, order: dict[str, Any]) -> None:
        if "secrets" in order:
            self._secrets.append(Path(order["secrets"]))
            return
        who = order["who"]
        if "prepare" in order:
            read, self._prepared[who] = os.pipe()
            self._start(order, read)
            os.close(read)
        elif who in self._prepared and "start" in order:
            pipe = self._prepared.pop(who)
            with contextlib.suppress(BrokenPipeError):  # it died meanwhile, and that will be said
                os.write(pipe, json.dumps(order).encode())
            os.close(pipe)
        elif "start" in order:
            self._start(order)
        else:
            for pid in [pid for pid, name in self._children.items() if name == who]:
                os.kill(pid, order["signal"])

    def _start(self, order: dict[str, Any], waits_on: int = -1) -> None:
        who = order["who"]
        try:
            self._children[self._fork(order, waits_on)] = who
        except OSError as e:
            text = f"{who} cannot be started: {e.strerror} (memory, or the limit of processes: ulimit -u)"
            self._tell({"event": "failed", "who": who, "text": text})

    def _fork(self, order: dict[str, Any], waits_on: int) -> int:
        """A child that obeys ``order``, or one that gets ready and then obeys what comes on ``waits_on``."""
        parent = os.getpid()
        pid = os.fork()
        if pid:
            self._tell({"event": "started", "who": order["who"], "pid": pid})
            return pid
        code = 70
        try:
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            self._control.close()
            # ended with the nursery, even when that is killed; the recorder gets to close its file
            recorder = order["who"] == "recorder"
            last_word = signal.SIGTERM if recorder else signal.SIGKILL
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(last_word))
            if os.getppid() == parent:
                setproctitle.setproctitle(f"duio-{order['who']}")
                for pipe in self._prepared.values():
                    os.close(pipe)
                if waits_on >= 0:
                    importlib.import_module("duio_mesh.recorder")  # the half second that is worth preparing
                    with os.fdopen(waits_on, "rb") as pipe_end:
                        order = json.loads(pipe_end.read() or "null")
                    if order is None:
                        os._exit(0)  # the nursery closes before there was anything to do
                errors = os.open(order["errors"], os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
                os.dup2(errors, 1)
                os.dup2(errors, 2)
                kind, run = KINDS[order["start"]]
                report = Report(order["who"], self._status, Path(order["log"]), watched=True)
                code = live(kind, run, Path(order["spec"]), report)
        except BaseException:
            traceback.print_exc()  # into its .err file, once that is open
            raise
        finally:
            sys.stderr.flush()
            os._exit(code)

    def _bury(self) -> None:
        while self._children:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if not pid:
                return
            self._tell({"event": "exit", "who": self._children.pop(pid), "code": os.waitstatus_to_exitcode(status)})

    def _tell(self, event: dict[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            self._control.sendall(json.dumps(event).encode() + b"\n")

    def _end_all(self, wake: int) -> None:
        for pid in self._children:
            os.kill(pid, signal.SIGTERM)
        end = time.monotonic() + GRACE
        self._bury()
        while self._children and (left := end - time.monotonic()) > 0:
            select.select([wake], [], [], left)
            with contextlib.suppress(BlockingIOError):
                os.read(wake, 4096)
            self._bury()
        for pid in self._children:  # a stopped process does not feel SIGTERM
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def main() -> None:
    """Serve the launcher, whose socket and pipe are the two arguments."""
    setproctitle.setproctitle("duio-nursery")
    gc.freeze()  # what is here now is shared by all children; do not let their collectors touch (and copy) it
    Nursery(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2])).serve()
