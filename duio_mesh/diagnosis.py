"""Who waits for whom, and who is to blame: what processes have said, put together.

Nothing is done here and nobody is asked; only ``Process.state`` looks at what the operating system says.
"""

from __future__ import annotations

import signal
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from duio_mesh.errors import STOPPED

SOURCES = ("plant", "gateway")
FEW = 6  # waits that a message names
STATES = {"T": "stopped", "t": "stopped by a debugger", "D": "waiting for a disk"}  # of /proc/<pid>/stat


class Process:
    """What is known of one process."""

    def __init__(self, who: str) -> None:
        self.who = who
        self.said: dict[str, Any] = {}  # what it reported when it was ready
        self.done: dict[str, Any] = {}  # its last words when all went well
        self.failure = ""  # what it says went wrong ...
        self.lost: Sequence[str] = ()  # ... and whose end was the cause
        self.code: int | None = None  # exit code; negative is a signal
        self.warnings: list[str] = []
        self.rejected: dict[str, int] = {}  # frames that it refused, by cause, as it says at its end
        self.pid = 0
        self.heard = 0.0  # when it, or the nursery about it, last said anything
        self.waits: dict[str, Any] = {}  # what it says that it waits for, when that takes long ...
        self.since = 0.0  # ... since when
        self.wakes: float | None = None  # it is stopped on purpose until then
        self.before = 0  # processes of this name before it
        self.back = False  # it replaces one and is in step
        self.there = True  # False: the run goes on without it

    def hear(self, event: Mapping[str, Any], now: float) -> None:
        """Take in what it, or the nursery about it, has said. ``now``: seconds of a steady clock."""
        what, self.heard = event["event"], now
        if what == "ready":
            self.said = dict(event)
        elif what == "done":
            self.done = dict(event)
        elif what == "failed":
            self.failure, self.lost = event["text"], event.get("lost", ())
        elif what == "warning":
            self.warnings.append(event["text"])
        elif what == "started":
            self.pid = event["pid"]
        elif what == "waiting":
            self.waits, self.since = dict(event), now - event["waited"]
        elif what == "moving":
            self.waits = {}
        elif what == "pausing":
            self.wakes = now + event["seconds"]
        elif what == "resumed":
            self.wakes = None
        elif what == "back":
            self.back = True
        elif what == "exit":
            self.code, self.waits = event["code"], {}
        self.rejected = event.get("rejected", self.rejected)

    @property
    def essential(self) -> bool:
        """A run does without its recorder."""
        return self.who != "recorder"

    def death(self) -> str:
        """How it ended, in words."""
        if self.code is not None and self.code < 0:
            return f"{self.who} was killed by {signal.Signals(-self.code).name}"
        if self.code == STOPPED:
            return f"{self.who} was asked to stop, by somebody else's SIGTERM"
        return self.failure or f"{self.who} ended with exit code {self.code}"

    def waiting(self) -> str:
        """What it waits for, in words."""
        on, link, k, r = (self.waits[key] for key in ("on", "link", "k", "r"))
        at = f"{link}, step {k}, round {r}" if link else f"step {k}"
        return f"{self.who} waits for {some(on)} ({at})"

    def state(self) -> str:
        """What the operating system says that it is doing; "" when that is nothing special or cannot be told."""
        try:
            stat = Path(f"/proc/{self.pid}/stat").read_text()
        except OSError:
            return ""
        return STATES.get(stat.rpartition(")")[2].split()[0], "")

    def stopped(self) -> bool:
        """Whether a signal or a debugger has stopped it."""
        return self.code is None and bool(self.pid) and self.state().startswith("stopped")


Processes: TypeAlias = Mapping[str, Process]


def some(names: Sequence[str]) -> str:
    """Names in words: of many, two and how many more."""
    return " and ".join(names) if len(names) <= 3 else f"{names[0]}, {names[1]} and {len(names) - 2} more"


def essential(processes: Processes) -> list[Process]:
    """Those that the run still needs."""
    return [p for p in processes.values() if p.essential and p.there]


def named(processes: Processes, who: str) -> Process:
    """A process as the others call it: a gateway is the plant to them."""
    return processes.get(who) or processes["gateway"]


def roots(processes: Processes) -> list[Process]:
    """Those that others wait for and who do not wait themselves, or only think so: they are stopped."""
    found: dict[str, Process] = {}
    for p in essential(processes):
        for who in p.waits.get("on", ()):
            other = named(processes, who)
            if other.there and (not other.waits or other.state()):
                found[who] = other
    return list(found.values())


def in_words(processes: Processes, few: int = FEW) -> str:
    """Who waits for whom, and what the operating system says of those who keep others waiting; "" when nobody.

    Of more waits than ``few``, those for whoever is the cause come first and the others are counted.
    """
    waiting = [p for p in essential(processes) if p.waits]
    causes = roots(processes)
    if len(waiting) > few:
        near = {p.who for p in causes}
        waiting.sort(key=lambda p: near.isdisjoint(named(processes, who).who for who in p.waits["on"]))
    more = [f"{len(waiting) - few} more wait"] if len(waiting) > few else []
    return "; ".join([*(p.waiting() for p in waiting[:few]), *more, *_states(causes)])


def culprits(processes: Processes, deadline: float, now: float) -> list[tuple[Process, list[str]]]:
    """Nodes that have kept others waiting for longer than ``deadline`` seconds, and who has waited so long.

    Not one that has said anything in that time: it has only just been freed itself, has taken the place of another, or
    is busy. The plant waits for all nodes alike, and may have begun to before those among them that only wait
    themselves could say so: it has to have waited for twice as long, unless the node is stopped.
    """
    late = [p for p in essential(processes) if p.waits and now - p.since > deadline]
    found = []
    for p in roots(processes) if late else ():
        silent = p.stopped() or now - p.heard > deadline
        if p.who.startswith("node-") and p.pid and p.code is None and silent:
            blamed = [other for other in late if p.who in other.waits["on"]]
            if any(o.waits["link"] or now - o.since > 2 * deadline for o in blamed) or (blamed and p.stopped()):
                found.append((p, [other.who for other in late]))
    return found


def owing(processes: Processes) -> list[Process]:
    """Processes that others have lost and that have not said yet why they ended."""
    lost = {who for p in essential(processes) for who in p.lost}
    found = [named(processes, who) for who in sorted(lost)]
    return [p for p in found if not p.failure and p.code is None]


def first_cause(processes: Processes) -> str:
    """Who was the first cause: a killed process before one that failed by itself, before one that lost a peer."""
    there = sorted(essential(processes), key=lambda p: p.who in SOURCES)  # they wait for all, and know least
    killed = [p.death() for p in there if p.code and (p.code < 0 or p.code == STOPPED)]
    failed = [p.failure for p in there if p.failure]
    first = [p.failure for p in there if p.failure and not p.lost]
    then = [text for text in failed if text not in first]
    return "; ".join([*killed, *first, *then, *stopped(processes)]) or "; ".join(p.death() for p in there if p.code)


def stopped(processes: Processes, but: Collection[Process] = ()) -> list[str]:
    """Who is stopped, whether somebody waits for it or not; in words."""
    return _states(p for p in essential(processes) if p not in but and p.stopped())


def _states(processes: Iterable[Process]) -> list[str]:
    return [f"{p.who} is {state}" for p in processes if (state := p.state())]
