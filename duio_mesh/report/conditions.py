"""How the processes and the edges are, as lanes, as a map, and as lines of the event log."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from duio_mesh.report import blueprint as look
from duio_mesh.report.entities import STATES, Entities

LEVELS = {"up": "INFO", "late": "WARN", "down": "ERROR"}


class Conditions:
    """Turns what is said of processes and arcs into changes of the recording; repeating a state says nothing new."""

    def __init__(
        self,
        entities: Entities,
        send: Callable[[str, Sequence[int], Any], None],
        event: Callable[[str, str, int], None],
        reached: Callable[[str], int],
    ) -> None:
        """``send(path, steps, columns)`` and ``event(text, level, step)`` write into the recording.

        ``reached(who)`` is the step after the last that a process has given.
        """
        self._entities, self._send, self._event, self._reached = entities, send, event, reached
        self._alive: dict[str, str] = {}
        self._leaving: dict[str, tuple[int, int]] = {}  # who -> (down from which step, how far it was at the last look)
        self._told: dict[tuple[int, int], str] = {}  # arc -> what was last said of it
        self._drawn: dict[tuple[int, int], str] = {}  # edge -> how it is drawn
        for i in entities.ids:
            self._ring(i, "unknown", 0)
        for edge in entities.edges:
            self._draw(edge, 0)

    def process(self, who: str, state: str, k: int) -> None:
        """``who`` (plant, node-3) is ``state`` from step k on; down is believed later, by ``settle``."""
        if state == "down":
            self._leaving[who] = (k, -1)
            return
        if who in self._leaving:  # gone and back before anybody could tell
            self._gone(who)
        self._change(who, state, k)

    def settle(self, *, final: bool = False) -> None:
        """Call down who has gone and has given nothing between two calls; ``final``: all who have gone.

        A process that gave its last step has done its work; its last rows may come after the news that it went.
        """
        for who, (k, reached) in list(self._leaving.items()):
            now = self._reached(who)
            if final or now == reached:
                self._gone(who)
            else:
                self._leaving[who] = (k, now)

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
        if self._reached(who) < self._entities.spec.steps:
            self._change(who, "down", k)

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
