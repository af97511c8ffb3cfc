"""What arrives at a realtime node: one queue for everything, with the time of its arrival."""

from __future__ import annotations

import time
from queue import SimpleQueue
from typing import TypeAlias

from duio_mesh.arrays import Array
from duio_mesh.mesh.frames import Decoder
from duio_mesh.mesh.session import Mesh, Ready, Source, at_once

At: TypeAlias = tuple[int, int]
"""(step, round)"""

GONE, BACK = b"gone", b"back"
BEFORE = (-1, 0)


class Link(Source):
    """One incoming link of a realtime node."""

    def __init__(self, mesh: Mesh, key: str, name: str, who: str, ready: Ready | None, inbox: Inbox) -> None:
        super().__init__(name, who, Decoder(mesh.keys.run, who))
        self.waiting: dict[At, tuple[float, Array]] = {}
        """Frames that are not due yet, and when they arrived."""
        self.vain = 0  # steps that it was waited for in vain since it was last heard of the step before, or a newer one
        inbox.links.append(self)
        mesh.sources.append(self)
        put = inbox.put
        mesh.subscribe(key, at_once(lambda sample: put(self, sample.payload.to_bytes())), ready)

    @property
    def newest(self) -> At:
        """Of the newest good frame."""
        return self.last or BEFORE


class Inbox:
    """Everything that arrives at this node, in the order and with the time of its arrival."""

    def __init__(self) -> None:
        self.links: list[Link] = []
        self._queue: SimpleQueue[tuple[Link | str, float, bytes]] = SimpleQueue()

    def put(self, source: Link | str, data: bytes) -> None:
        """A frame of a link, or news (GONE, BACK) of a process; on a thread of Zenoh's."""
        self._queue.put((source, time.monotonic(), data))

    def __len__(self) -> int:
        return self._queue.qsize()

    def get(self, timeout: float) -> tuple[Link, float, bytes] | None:
        """The next frame; None when it was news, which is entered with the links. Raises Empty after ``timeout``."""
        source, at, data = self._queue.get(timeout=timeout) if timeout > 0 else self._queue.get_nowait()
        if isinstance(source, Link):
            return source, at, data
        for link in self.links:
            if link.who == source:
                link.gone = data == GONE
        return None
