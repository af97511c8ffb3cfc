"""How the processes and the edges are, as lanes, as a map, and as lines of the event log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

from duio_mesh.report import blueprint as look
from duio_mesh.report.entities import STATES, Entities
from duio_mesh.report.pairing import Spans

LEVELS = {"up": "INFO", "late": "WARN", "down": "ERROR"}


class Conditions:
    """Turns what is said of processes and arcs into changes of the recording; repeating a state says nothing new."""

    def __init__(
        self,
        entities: Entities,
        send: Callable[[str, Sequence[int], Any], None],
        event: Callable[[str, str, int], None],
        seen: Callable[[str], Spans],
    ) -> None:
        """``send(path, steps, columns)`` and ``event(text, level, step)`` write into the recording.

        ``seen(who)`` are the steps of which a process has given rows.
        """
        self._entities, self._send, self._event, self._seen = entities, send, event, seen
        self._alive: dict[str, str] = {}
        self._leaving: dict[str, tuple[int, int]] = {}  # who -> (down from which step, how far it was at the last look)
        self._back: dict[str, int] = {}  # who has come back -> from about which step on
        self._told_of: dict[str, int] = {}  # who -> the step after its last gap that was told
        self._told: dict[tuple[int, int], str] = {}  # arc -> what was last said of it
        self._drawn: dict[tuple[int, int], str] = {}  # edge -> how it is drawn
        for i in entities.ids:
            self._ring(i, "unknown", 0)
        for edge in entities.edges:
            self._draw(edge, 0)

    def process(self, who: str, state: str, k: int) -> None:
        """``who`` (plant, node-3) is ``state`` from step k on; down is believed later, by ``settle``.

        Everybody is up from the first step on; news of it may come late. News that somebody is gone and back may come
        late too, or ahead of the rows: when that was the gap between the rows says.
        """
        if state == "down":
            self._leaving[who] = (k, -1)
        elif state == "up" and (who in self._leaving or self._alive.get(who) == "down"):
            self._back[who] = k
        else:
            self._change(who, state, 0 if state == "up" and who not in self._alive else k)

    def settle(self, *, final: bool = False) -> None:
        """Call down who has gone and has given nothing between two calls; ``final``: all who have gone.

        A process that gave its last step has done its work; its last rows may come after the news that it went.
        """
        self._tell_gaps(final=final)
        for who, (k, reached) in list(self._leaving.items()):
            now = self._reached(who)
            if final or (now == reached and who not in self._back):
                self._gone(who)
            else:
                self._leaving[who] = (k, now)
        for who, k in list(self._back.items()) if final else ():  # there and back without a row since
            self._change(who, "up", k)
            del self._back[who]

    def arc(self, i: int, j: int, state: str, k: int) -> None:
        """The arc on which i tells j is ``state`` from step k on. Raises KeyError when there is none."""
        if (i, j) not in self._entities.spec.arcs:
            raise KeyError(f"node {i} does not tell node {j}")
        if self._told.get((i, j), "up") != state:
            self._event(f"edge {i} to {j} is {state}" + (" again" if state == "up" else ""), LEVELS[state], k)
        self._told[i, j] = state
        self._draw((min(i, j), max(i, j)), k)

    def _gone(self, who: str) -> None:
        k, _ = self._leaving.pop(who)
        reached = self._reached(who)
        if reached < self._entities.spec.steps:
            self._change(who, "down", max(k, reached))

    def _reached(self, who: str) -> int:
        """The step after the last that a process has given."""
        return max((last for _, last in self._seen(who)), default=0)

    def _tell_gaps(self, *, final: bool) -> None:
        """Say of those who have come back from when to when they were away: before ``final``, one gap of each."""
        changes = []
        for who in list(self._back):
            gaps = [(a, b) for (_, a), (b, _) in pairwise(self._seen(who)) if b > self._told_of.get(who, 0)]
            for a, b in gaps if final else gaps[:1]:
                changes += [(a, who, "down"), (b, who, "up")]
                self._told_of[who] = b
            if gaps:
                del self._back[who]
                if self._leaving.get(who, (0, 0))[0] < self._told_of[who]:  # that was this gap, and nothing newer
                    self._leaving.pop(who, None)
        for k, who, state in sorted(changes, key=lambda change: change[0]):  # edges look at both their ends
            self._change(who, state, k)

    def _change(self, who: str, state: str, k: int) -> None:
        before = self._alive.get(who)
        if before == state:
            return
        if before or state != "up":
            self._event(f"{who} is {state}" + (" again" if state == "up" else ""), LEVELS[state], k)
        self._alive[who] = state
        self._send(self._entities.alive(who), [k], look.states([state]))
        if who.startswith("node-"):
            i = int(who.removeprefix("node-"))
            self._ring(i, state, k)
            for edge in self._entities.edges:
                if i in edge:
                    self._draw(edge, k)

    def _draw(self, edge: tuple[int, int], k: int) -> None:
        """An edge looks as bad as its worse end, or as what was last said of one of its directions."""
        ends = [self._alive.get(f"node-{i}", "unknown") for i in edge]
        told = [self._told.get(arc, "up") for arc in (edge, edge[::-1])]
        state = max(ends + told, key=list(STATES).index)
        if self._drawn.get(edge) != state:
            self._drawn[edge] = state
            both_ways = self._entities.edges[edge]
            self._send(self._entities.edge(*edge), [k], look.edge_colours([STATES[state]], both_ways=both_ways))

    def _ring(self, i: int, state: str, k: int) -> None:
        self._send(self._entities.ring(i), [k], look.node_colours([STATES[state]]))
