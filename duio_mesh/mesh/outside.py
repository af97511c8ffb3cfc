"""A Zenoh session of its own for the outside world: who reaches it reaches one queue, and no link of the mesh."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from functools import partial
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple, Self

import zenoh

from duio_mesh.errors import RunError
from duio_mesh.mesh.session import at_once, close
from duio_mesh.spec import START, Outside

QUEUE = 200_000  # messages that may wait; further ones are counted and dropped
LARGEST = 1 << 20  # bytes of a message; a longer one is not even put together from its fragments


class Heard(NamedTuple):
    """One message of the outside world, or (key "") the word that there will be no more."""

    key: str  # as the topology file has it
    payload: bytes | None  # None: the key was deleted
    attachment: bytes | None
    stray: bool = False  # nobody of this run measures that


def _config(outside: Outside) -> zenoh.Config:
    """A peer that others connect to, or a client of a router; no scouting, no gossip."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer" if outside.listen else "client",
        "listen/endpoints": [outside.listen] if outside.listen else [],
        "connect/endpoints": [outside.connect] if outside.connect else [],
        "connect/timeout_ms": int(START * 1000),
        "connect/exit_on_failure": True,
        "open/return_conditions/connect_scouted": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/rx/max_message_size": LARGEST,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class OutsideWorld:
    """Hears the keys of a run's sensors; a context manager."""

    def __init__(self, outside: Outside, warn: Callable[[str], None]) -> None:
        """Open the session. Raises RunError when its endpoint cannot be used or reached."""
        self._warn = warn
        self._queue = SimpleQueue[Heard]()
        self.dropped = 0  # messages that found the queue full
        where = f"listen on {outside.listen}" if outside.listen else f"connect to {outside.connect}"
        try:
            self._session = zenoh.open(_config(outside))
            self._kept = [self._subscribe(key, partial(self._take, key)) for key in outside.sizes]
            if outside.end:
                self._kept.append(self._subscribe(outside.end, lambda _: self._queue.put(Heard("", b"", None))))
            if outside.strays:
                known = frozenset((*outside.sizes, outside.end))
                self._kept.append(self._subscribe(outside.strays, partial(self._stray, known)))
        except zenoh.ZError as e:
            raise RunError(f"the gateway could not {where} for the sensors: {e}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        close(self._session, self._warn)

    def get(self, timeout: float) -> Heard | None:
        """The next message, None when there is none within ``timeout`` seconds."""
        try:
            return self._queue.get(timeout=timeout)
        except Empty:
            return None

    def at_once(self, most: int) -> Iterator[Heard]:
        """Of the messages that are here already the next ones, ``most`` at most."""
        for _ in range(min(most, self._queue.qsize())):
            yield self._queue.get()  # nobody else takes from it

    def _subscribe(self, key: str, callback: Callable[[Any], None]) -> Any:
        return self._session.declare_subscriber(key, at_once(callback))

    def _take(self, key: str, sample: Any) -> None:
        """On a thread of Zenoh's: only copies."""
        if self._queue.qsize() >= QUEUE:
            self.dropped += 1
            return
        put = sample.kind == zenoh.SampleKind.PUT
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else None
        self._queue.put(Heard(key, sample.payload.to_bytes() if put else None, attachment))

    def _stray(self, known: frozenset[str], sample: Any) -> None:
        """A key of the same form that is no sensor of this run: most likely a wrong number."""
        key = str(sample.key_expr)
        if key not in known and self._queue.qsize() < QUEUE:
            self._queue.put(Heard(key[:200], None, None, stray=True))
