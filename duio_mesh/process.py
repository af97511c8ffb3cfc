"""What plant, node and recorder processes have in common: how they start, say how they are, and end.

A process reports events as JSON lines, to the launcher's pipe when it was started by the launcher, else to its standard
output. Ends: 0 done, 3 failed (the reason is the last event), 143 asked to stop by SIGTERM.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from duio_mesh.errors import STOPPED, DuioError
from duio_mesh.spec import Spec, read_spec

FAILED = 3


class Stop(BaseException):
    """Raised in the main thread by SIGTERM, so that every ``with`` is left properly."""


class Report:
    """Says what happens in a process, one JSON line an event."""

    def __init__(self, who: str, fd: int, log: Path | None = None, *, watched: bool = False) -> None:
        """``fd``: where events go; ``log``: a file for them beside; ``watched``: a launcher wants signs of life."""
        self._who, self._fd, self._watched = who, fd, watched
        self._log = log.open("a") if log else None
        self.last: Callable[[], dict[str, Any]] = dict
        """What a process that fails, or is stopped, has to say besides."""

    def __call__(self, event: str, **fields: Any) -> None:
        """Report ``event``; a launcher that is gone is not an error here (the process is about to be ended)."""
        if self._log:
            self._log.write(json.dumps({"time": round(time.time(), 6), "event": event, **fields}) + "\n")
            self._log.flush()
        self._say({"event": event, **fields})

    def _say(self, event: dict[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError):
            os.write(self._fd, json.dumps({"who": self._who, **event}).encode() + b"\n")

    def beat(self) -> None:
        """Show a launcher that things move, though no step may be finished for long. Not an event, not logged."""
        if self._watched:
            self._say({"event": "beat"})

    def warn(self, text: str) -> None:
        """Report something odd that does not end the process."""
        self("warning", text=text)


def live(kind: type[Spec], run: Callable[[Spec, Report], None], path: Path, report: Report) -> int:
    """Read the spec, run, report; the exit code. Nothing is raised but SystemExit's relatives."""
    _share_the_processor()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the launcher's to handle: it asks everybody to stop

    def stop(signum: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise Stop

    signal.signal(signal.SIGTERM, stop)
    try:
        run(read_spec(path, kind), report)
    except Stop:
        report("stopped", **report.last())
        return STOPPED
    except (DuioError, ValueError, OSError) as e:
        report("failed", text=str(e), lost=getattr(e, "lost", ()), **report.last())
        return FAILED
    except Exception as e:
        trace = traceback.format_exc()[-2000:]
        report("failed", text=f"{type(e).__name__}: {e}", traceback=trace, **report.last())
        return FAILED
    return 0


def _share_the_processor() -> None:
    """Let whoever is running finish its round: a message that wakes a process shall not interrupt another one.

    With more processes than cores this saves most of the switching between them, and half as many rounds again fit into
    a second (docs/performance.md). Threads that are started later inherit it. Elsewhere than on Linux there is no such
    thing.
    """
    if hasattr(os, "SCHED_BATCH"):
        with contextlib.suppress(PermissionError):  # out of the idle class, for one; it only costs speed
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def main(kind: type[Spec], run: Callable[[Spec, Report], None]) -> NoReturn:
    """The command line of one process, for containers and hosts without the launcher."""
    parser = argparse.ArgumentParser(description=f"Run one process of a duio_mesh run from its {kind.__name__}.")
    parser.add_argument("--spec", type=Path, required=True, help="spec file that the launcher or an export wrote")
    parser.add_argument("--log", type=Path, help="also append what it reports to this file, as JSON lines")
    args = parser.parse_args()
    code = live(kind, run, args.spec, Report(args.spec.stem, 1, args.log))
    sys.stderr.flush()
    os._exit(code)  # everything is closed; a thread that still talks to a frozen peer must not keep us
