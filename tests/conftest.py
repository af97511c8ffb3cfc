"""Shared by all tests: nothing may be left behind."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy: many small products, and other processes want the cores

ROOT = Path(__file__).parent.parent
TOPOLOGIES = ROOT / "topologies"


def simulated() -> list[str]:
    """Names of the topologies whose plant is simulated, so that there is an oracle; the others are fed from outside."""
    return sorted(p.stem for p in TOPOLOGIES.glob("*.yaml") if "\nplant: external\n" not in p.read_text())


def started_in(folder: Path) -> list[psutil.Process]:
    """Every other process that was started in this folder (the processes of a run inherit it)."""
    found = []
    for p in psutil.process_iter(["cwd", "status"]):
        here = Path(p.info["cwd"] or "/").is_relative_to(folder)
        if here and p.pid != os.getpid() and p.info["status"] != psutil.STATUS_ZOMBIE:
            found.append(p)
    return found


@pytest.fixture
def nothing_left(tmp_path: Path) -> Iterator[None]:
    """Fails the test when a process of a run outlives it by more than the five seconds that an end may take."""
    yield
    _, left = psutil.wait_procs(started_in(tmp_path), timeout=5)
    names = [p.name() for p in left]
    for p in left:
        p.kill()
    assert not names, f"left behind: {names}"


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs go to ./runs by default: keep them out of the checkout."""
    monkeypatch.chdir(tmp_path)


def wait_for(condition: Callable[[], object], timeout: float = 30.0) -> None:
    """Until an outside condition (another process' file or state) is true; fails the test after ``timeout`` seconds."""
    end, never = time.monotonic() + timeout, threading.Event()
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        never.wait(0.02)
