"""From the samples of single sensors to complete steps: y of everybody for step k, or not yet.

A sample belongs to a step by its number, or in order of arrival where a publisher does not count. Where numbers are
common to all sensors, step 0 is the first number that all of them have sent; else it is what was newest of each when
the last one had spoken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf

from duio_mesh.arrays import Array
from duio_mesh.sensors.messages import Refused, Sample

BACKLOG = 65_536  # samples of one sensor that may wait


@dataclass
class Feed:
    """What is known of one sensor."""

    counts: bool | None = None  # whether its samples have numbers; None: nothing came yet
    waiting: dict[int, Array] = field(default_factory=dict)  # by number
    base: int = 0  # the number of its sample of step 0
    arrived: int = 0  # samples, where it does not count
    newest: int = -1  # number
    last: Array | None = None  # its value of the newest complete step


class Steps:
    """Collects samples; ``next`` is the next complete step."""

    def __init__(self, keys: Mapping[str, object], *, common: bool, hold: float = inf) -> None:
        """``common``: the numbers of all sensors mean the same. ``hold``: seconds after a step's first sample in which
        the others may come; then the last values of those that have not are used again.
        """
        self._feeds = {key: Feed() for key in keys}
        self._common, self._hold = common, hold
        self._since: float | None = None  # when the first sample of the present step was seen
        self.k = 0  # the step that is due
        self.started = False
        self.held: Counter[str] = Counter()  # values that were used again, by key

    def add(self, key: str, sample: Sample) -> None:
        """Take one sample. Raises Refused when it belongs to no step that is still to come."""
        feed = self._feeds[key]
        if sample.number is None and self._hold < inf:
            raise Refused("no number, and hold needs one")
        counts = sample.number is not None
        if feed.counts is not None and counts != feed.counts:
            raise Refused("with a number, and others without")
        number = feed.arrived if sample.number is None else sample.number
        if number in feed.waiting or (self.started and number < feed.base + self.k):
            raise Refused("seen before")
        if self.started and (len(feed.waiting) >= BACKLOG or number - feed.base - self.k >= BACKLOG):
            raise Refused("too far ahead")
        if len(feed.waiting) >= BACKLOG:  # others have not spoken yet: the oldest will hardly be needed
            feed.waiting.pop(next(iter(feed.waiting)))
        feed.counts, feed.arrived, feed.newest = counts, feed.arrived + 1, max(feed.newest, number)
        feed.waiting[number] = sample.values
        if not self.started:
            if not (self._common and counts):  # nothing is due yet: only the newest will count
                feed.waiting = {number: sample.values}
            self._start()

    def next(self, now: float, *, over: bool = False) -> dict[str, Array] | None:
        """The values of step k by key, None while there is nothing complete.

        ``now``: seconds of any steady clock; ``over``: nothing more will come, so who is late stays late.
        """
        missing = self.missing()
        if missing and not self._overdue(missing, now, over):
            return None
        step = {}
        for key, feed in self._feeds.items():
            if key in missing:
                assert feed.last is not None, "step 0 is never held"  # noqa: S101
                self.held[key] += 1
            else:
                feed.last = feed.waiting.pop(feed.base + self.k)
            step[key] = feed.last
        self.k += 1
        self._since = None
        return step

    def missing(self) -> list[str]:
        """Keys whose sample of step k is not here."""
        if not self.started:
            return [key for key, feed in self._feeds.items() if feed.counts is None]
        return [key for key, feed in self._feeds.items() if feed.base + self.k not in feed.waiting]

    def doing(self, key: str) -> str:
        """What a sensor last sent, in words."""
        feed = self._feeds[key]
        if feed.counts is None:
            return "nothing came"
        wanted = f"its sample {feed.base + self.k} is missing; " if self.started and feed.counts else ""
        return wanted + (f"the last was number {feed.newest}" if feed.counts else f"{feed.arrived} samples came")

    def _overdue(self, missing: list[str], now: float, over: bool) -> bool:
        if not self.started or self.k == 0 or len(missing) == len(self._feeds):
            return False
        if self._since is None:
            self._since = now
        return now - self._since >= self._hold or (over and self._hold < inf)

    def _start(self) -> None:
        """Begin when everybody has spoken."""
        feeds = self._feeds.values()
        if any(feed.counts is None for feed in feeds):
            return
        first = max((min(feed.waiting) for feed in feeds if feed.counts and self._common), default=0)
        for feed in feeds:
            feed.base = first if feed.counts and self._common else min(feed.waiting)
            feed.waiting = {number: values for number, values in feed.waiting.items() if number >= feed.base}
        self.started = True
