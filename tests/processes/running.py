"""A run started from the command line, as a user would, and what can be done to it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, Self

import psutil

from tests.conftest import ROOT, TOPOLOGIES, wait_for

LONG = 2_000_000  # steps: more than any test lets pass


class Running:
    """``python launch.py TOPOLOGY ... --out run`` in the present folder; ended with the ``with``."""

    def __init__(self, topology: str, *options: str, steps: int = LONG) -> None:
        self.out = Path("run").absolute()
        command = [sys.executable, str(ROOT / "launch.py"), str(TOPOLOGIES / topology), "--out", str(self.out)]
        self.process = subprocess.Popen(
            [*command, "--steps", str(steps), *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.stdout = self.stderr = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.communicate()

    def said(self, who: str) -> list[dict[str, Any]]:
        """The events in one process' log."""
        log = self.out / "logs" / f"{who}.jsonl"
        return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []

    def until_ready(self, who: str) -> None:
        """Wait until a process has reported that it is ready."""
        wait_for(lambda: any(e["event"] == "ready" for e in self.said(who)))

    def until_row(self, who: str, row: int) -> None:
        """Wait until a process has written this many bytes' worth of rows of nine."""
        path = self.out / "rows" / f"{who}.f64"
        wait_for(lambda: path.exists() and path.stat().st_size >= row * 9 * 8)

    def pid(self, who: str) -> int:
        """The pid of a process of this run, found by its name among the launcher's descendants."""
        for p in psutil.Process(self.process.pid).children(recursive=True):
            with contextlib.suppress(psutil.NoSuchProcess):  # it has just ended
                if p.name() == f"duio-{who}" or f"duio-{who}" in p.cmdline():
                    return p.pid
        raise AssertionError(f"no process duio-{who}")

    def exists(self, who: str) -> bool:
        """Whether there is such a process."""
        try:
            return bool(self.pid(who))
        except AssertionError:
            return False

    def send(self, who: str, number: signal.Signals) -> None:
        """A signal to one process of the run, or to the launcher."""
        os.kill(self.process.pid if who == "launcher" else self.pid(who), number)

    def end(self, timeout: float = 60.0) -> int:
        """Wait for the launcher's end; its exit code."""
        self.stdout, self.stderr = self.process.communicate(timeout=timeout)
        return self.process.returncode

    def metrics(self) -> dict[str, Any]:
        """metrics.json."""
        found: dict[str, Any] = json.loads((self.out / "metrics.json").read_text())
        return found
