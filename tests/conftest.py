"""Shared by all tests: nothing may be left behind."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

ROOT = Path(__file__).parent.parent
TOPOLOGIES = ROOT / "topologies"


def ours() -> list[psutil.Process]:
    """Every process of a run (they carry ``duio-`` names) and every child of this one."""
    found = []
    for p in psutil.process_iter(["name", "cmdline"]):
        named = (p.info["name"] or "").startswith("duio-") or any("duio_mesh" in a for a in p.info["cmdline"] or [])
        if named and p.pid != os.getpid() and p.status() != psutil.STATUS_ZOMBIE:
            found.append(p)
    return found


@pytest.fixture
def nothing_left() -> Iterator[None]:
    """Fails the test when a process of a run outlives it by more than the five seconds that an end may take."""
    before = {p.pid for p in ours()}
    yield
    left = [p for p in ours() if p.pid not in before]
    _, left = psutil.wait_procs(left, timeout=5)
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
