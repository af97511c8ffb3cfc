"""The processes of a run as the kernel sees them: who they are and what memory they hold.

Without pathlib, which interns the parts of every path: looked at often enough, the table of interned strings doubles.
"""

from __future__ import annotations

import contextlib
import os
from glob import glob
from typing import NamedTuple


class Memory(NamedTuple):
    """In MB. PSS counts a page that k processes share as 1/k of a page, so it changes with what others do."""

    rss: float
    own: float  # anonymous: what it allocated or wrote to, no code and no files
    pss: float


def descendants(pid: int) -> list[int]:
    """All processes below this one."""
    found: list[int] = []
    for path in glob(f"/proc/{pid}/task/*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            for child in map(int, _read(path).split()):
                found += [child, *descendants(child)]
    return found


def family() -> dict[str, int]:
    """Name -> id of the processes of the run that this process launched, and of this one, `launcher`."""
    found = {"launcher": os.getpid()}
    for pid in descendants(os.getpid()):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            name = _read(f"/proc/{pid}/cmdline").split("\0")[0]
            if name.startswith("duio-"):
                found[name.removeprefix("duio-")] = pid
    return found


def memory(pid: int) -> Memory:
    """Raises FileNotFoundError or ProcessLookupError when the process has ended."""
    lines = _read(f"/proc/{pid}/smaps_rollup").splitlines()
    sizes = {line.split(":")[0]: int(line.split()[1]) / 1024 for line in lines[1:]}
    return Memory(sizes["Rss"], sizes["Anonymous"], sizes["Pss"])


def memories() -> dict[str, Memory]:
    """Of every process of the run that this process launched, and of this one."""
    found = {}
    for who, pid in family().items():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError, KeyError):
            found[who] = memory(pid)
    return found


def _read(path: str) -> str:
    with open(path, encoding="utf-8", errors="replace") as f:
        return f.read()
