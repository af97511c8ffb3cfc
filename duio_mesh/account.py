"""What the processes of a run have said, on this host or, by their logs, on others."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from duio_mesh import diagnosis
from duio_mesh.diagnosis import Process

TOLD = ("lost", "joined", "back", "dying", "pausing", "resumed", "waiting")


class Account:
    """Every process of one run, and what has happened on the way."""

    def __init__(self) -> None:
        self.processes: dict[str, Process] = {}
        self.events: list[dict[str, Any]] = []  # what has happened to nodes on the way
        self.note = ""  # what a gateway waits for
        self.words = 0  # whatever anybody says shows that things move ...
        self.news = False  # ... and most of it may be worth doing something about at once
        self._begin = time.monotonic()

    def hear(self, event: Mapping[str, Any]) -> None:
        """Take in one event. Raises KeyError where it is none, or of a process that nobody knows."""
        what, who = event["event"], event["who"]
        self.words += 1
        self.news = self.news or what != "beat"
        self.processes[who].hear(event, time.monotonic())
        if what == "sensors":
            self.note = event["text"]
        if what in TOLD:
            self.remember(what, **{key: value for key, value in event.items() if key != "event"})

    def remember(self, what: str, **fields: Any) -> None:
        """Keep an event for whoever wants to know afterwards what happened on the way."""
        self.events.append({"seconds": round(time.monotonic() - self._begin, 3), "event": what, **fields})

    def waiting(self, few: int = diagnosis.FEW) -> str:
        """Who waits for whom, in words (``diagnosis.in_words``)."""
        return diagnosis.in_words(self.processes, few)
