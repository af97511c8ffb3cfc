"""One Zenoh peer per process: links only where the graph has edges, and waits that always end.

Two ways to receive. What comes now and then from many (credits, traces) goes through one queue to ``Mesh.get``; a peer
that disappears is put into the same queue, behind everything it had sent. The exchange of a node with its neighbours,
which is the hot path, waits on one channel per neighbour instead: see lockstep.py.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import Any, NamedTuple, Self, TypeAlias

# Before the first zenoh.open: all of Zenoh's work on one thread, except sending, which keeps its own (handing that over
# as well can deadlock). About 1.3 times the rounds per second of the default runtime, and 4 threads instead of 9.
os.environ.setdefault(
    "ZENOH_RUNTIME", "(acc:(handover:app),rx:(handover:app),net:(handover:app),app:(worker_threads:1))"
)

import zenoh

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.mesh import security
from duio_mesh.mesh.frames import Decoder, Encoder, Frame, Rejected
from duio_mesh.mesh.keys import Keys
from duio_mesh.spec import Wire

CLOSE = 2.0  # seconds to end a session in order

Ready: TypeAlias = tuple[int | str, int | str]  # (source, target) of a link, for the start barrier


def configured(wire: Wire) -> zenoh.Config:
    """These endpoints and no others: no multicast, no gossip, no shared memory (payloads are small)."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": wire.mode,
        "listen/endpoints": list(wire.listen),
        "connect/endpoints": list(wire.connect),
        "connect/retry": {"period_init_ms": 10, "period_max_ms": 100, "period_increase_factor": 1.5},
        "connect/timeout_ms": int(wire.start * 1000),
        "connect/exit_on_failure": True,
        "transport/link/tx/lease": int(wire.lease * 1000),
        # microseconds; else BLOCK gives up a peer that takes nothing after five seconds, and all that is queued for it
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(wire.lease * 1_000_000),
        "open/return_conditions/connect_scouted": False,  # else every open waits half a second for scouting
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        # one queue per link: with one per priority, the news that somebody has gone may overtake the last that it said
        "transport/unicast/qos/enabled": False,
        **security.settings(wire),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def at_once(callback: Callable[[Any], None]) -> Any:
    """Call back on Zenoh's own thread. The plain form would start a thread of its own for every subscriber."""
    return zenoh.handlers.Callback(callback, indirect=False)


def close(session: zenoh.Session, warn: Callable[[str], None]) -> None:
    """End a session in order; after ``CLOSE`` seconds leave without it: a frozen peer would hold that up for ever."""
    closing = threading.Thread(target=session.close, daemon=True)
    closing.start()
    closing.join(CLOSE)
    if closing.is_alive():
        warn(f"left without an orderly end: a peer did not take what was queued for it within {CLOSE:g} s")


def _matched(news: SimpleQueue[str], name: str, status: Any) -> None:
    if status.matching:  # the status is an object: it is always true
        news.put(name)


class Member(NamedTuple):
    """One process, whatever it is called."""

    who: str
    before: int = 0  # processes of that name before it


class Source:
    """One incoming key: who sends on it, what it has sent, and what of it was refused."""

    def __init__(self, name: str, who: str, decode: Decoder) -> None:
        self.name = name  # as the user knows it: "edge 3 -> 2"
        self.who, self.before = who, 0  # the process: "node-3", and how many of that name there were before it
        self.decode = decode
        self.last: tuple[int, int] | None = None  # (k, r) of the newest good frame
        self.rejected: Counter[str] = Counter()
        self.gone = False

    def doing(self) -> str:
        """What the other side last did, for messages to people."""
        parts = ["it has gone"] if self.gone else []
        parts.append(
            "it sent nothing yet" if self.last is None else "it last sent step {}, round {}".format(*self.last)
        )
        parts += [f"{n} of its frames were refused ({cause})" for cause, n in self.rejected.items()]
        return "; ".join(parts)


class Outlet:
    """One or more outgoing keys that carry the same frames."""

    def __init__(self, encoder: Encoder, publishers: list[Any]) -> None:
        self._encode, self._publishers = encoder, publishers
        self.frames = 0

    def send(self, k: int, r: int, vector: Array) -> None:
        """Send the vector of step k, round r on every key. Blocks while a peer's queue is full (BLOCK keys only)."""
        frame = self._encode(k, r, vector)
        for publisher in self._publishers:
            publisher.put(frame)
        self.frames += len(self._publishers)

    def send_to(self, at: int, k: int, r: int, vector: Array) -> None:
        """As ``send``, on key number ``at`` only."""
        self._publishers[at].put(self._encode(k, r, vector))
        self.frames += 1

    def send_each(self, k: int, r: int, vector: Array, spoil: Callable[[int, bytes], Iterable[bytes]]) -> None:
        """As ``send``, but key number ``at`` carries what ``spoil(at, frame)`` makes of the frame."""
        frame = self._encode(k, r, vector)
        for at, publisher in enumerate(self._publishers):
            for sent in spoil(at, frame):
                publisher.put(sent)
                self.frames += 1


class Mesh:
    """The Zenoh side of one process; a context manager.

    Declare sources and outlets, then ``meet`` (the start barrier), then ``get`` and ``send``.
    """

    def __init__(self, wire: Wire, who: str, warn: Callable[[str], None] = lambda _: None, before: int = 0) -> None:
        """Open the session of a process that replaces ``before`` others of its name.

        Raises RunError when an endpoint cannot be used or reached.
        """
        self.who, self.keys, self._before = who, Keys(wire.run), before
        self._warn, self._start = warn, wire.start
        self._queue: SimpleQueue[tuple[Source | Member, bytes | None]] = SimpleQueue()
        self.sources: list[Source] = []
        self._news = threading.Condition()
        self._seen, self._here = set[Member](), set[Member]()  # processes with a direct link: ever, and at present
        self._meeting: dict[str, Any] = {}  # name of a link -> publisher that must match before the start
        self._kept: list[Any] = []
        try:
            self._session = zenoh.open(configured(wire))
        except zenoh.ZError as e:
            raise RunError(
                f"{who} could not open its links (listen {wire.listen}, connect {wire.connect}): {e}"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """``close``: always, or the interpreter might never exit."""
        self.close()

    def close(self) -> None:
        """End the session, which sends what is still queued."""
        close(self._session, self._warn)

    # -- declaring --------------------------------------------------------------------------------------------------

    def hear(self, key: str, name: str, who: str, ready: Ready | None = None) -> Source:
        """Let ``get`` return what the process ``who`` sends on ``key``; ``ready`` names the link for the start barrier.

        For what comes now and then from many. The lockstep exchange of a node is in lockstep.py.
        """
        source = Source(name, who, Decoder(self.keys.run, who))
        self.sources.append(source)
        put = self._queue.put
        self.subscribe(key, at_once(lambda sample: put((source, sample.payload.to_bytes()))), ready)
        return source

    def subscribe(self, key: str, handler: Any, ready: Ready | None) -> Any:
        """A Zenoh subscriber that lives as long as the mesh; ``ready`` announces it to the start barrier."""
        self._kept.append(subscriber := self._session.declare_subscriber(key, handler))
        if ready:  # after the data subscriber, on the same link: whoever sees this one can be heard
            self.announce(ready)
        return subscriber

    def tell_self(self, key: str, data: bytes) -> None:
        """Put a message into our own subscriber's channel; it does not leave this process."""
        self._session.put(key, data, allowed_destination=zenoh.Locality.SESSION_LOCAL)

    def announce(self, ready: Ready) -> None:
        """Answer the start barrier on this link, whose data subscriber is there already."""
        self._kept.append(self._session.declare_subscriber(self.keys.ready(*ready), zenoh.handlers.FifoChannel(1)))

    def speak(self, links: Iterable[tuple[str, str, Ready | None]], drop: bool = False) -> Outlet:
        """Publish on every (key, name, ready) of ``links``; with ``drop`` a slow receiver costs frames, not time."""
        publishers = []
        for key, name, ready in links:
            control = zenoh.CongestionControl.DROP if drop else zenoh.CongestionControl.BLOCK
            publishers.append(self._session.declare_publisher(key, congestion_control=control, express=False))
            if ready:
                self.expect(name, ready)
        return Outlet(Encoder(self.keys.run, self.who), publishers)

    def expect(self, name: str, ready: Ready) -> None:
        """Let the start barrier wait for somebody at the other end of this link."""
        self._meeting[name] = self._session.declare_publisher(self.keys.ready(*ready))

    def watch(self, changed: Callable[[Member, bool], None] | None = None) -> None:
        """Announce this process and notice when a directly linked one comes or goes (``changed(member, alive)``).

        ``changed`` is called on a thread of Zenoh's and must return at once. To be called after everything that this
        process hears has been declared: who sees it announced can reach it.
        """
        self._kept.append(self._session.liveliness().declare_token(self.keys.alive(self.who, self._before)))
        put, start = self._queue.put, len(self.keys.alive(""))

        def tell(member: Member, alive: bool) -> None:
            if changed:
                changed(member, alive)
            if not alive:
                put((member, None))

        def seen(sample: Any) -> None:
            who, _, before = str(sample.key_expr)[start:].partition("/")
            member, alive = Member(who, int(before or 0)), sample.kind == zenoh.SampleKind.PUT
            with self._news:
                if alive:
                    self._seen.add(member)
                    self._here.add(member)
                else:
                    self._here.discard(member)
                self._news.notify_all()
            if alive and member.before:  # the one before it is dead, though we may never have seen it announced
                tell(Member(who, member.before - 1), False)
            tell(member, alive)

        everyone = self.keys.alive("**")
        self._kept.append(self._session.liveliness().declare_subscriber(everyone, at_once(seen), history=True))

    def alive(self, member: Member) -> bool:
        """Whether a directly linked process has announced itself and not gone since."""
        return member in self._here

    def await_birth(self, member: Member, timeout: float) -> bool:
        """Wait until this process has announced itself; is it there?"""
        with self._news:
            self._news.wait_for(lambda: member in self._seen, timeout)
            return self.alive(member)

    def await_somebody(self, who: str, timeout: float) -> Member | None:
        """Wait until a process of this name is there; the newest."""
        with self._news:
            self._news.wait_for(lambda: any(m.who == who for m in self._here), timeout)
            return max((m for m in self._here if m.who == who), default=None)

    # -- the start barrier ------------------------------------------------------------------------------------------

    def meet(self, timeout: float | None = None) -> None:
        """Wait until every link that was declared so far has somebody at its other end.

        Raises RunError naming the links that nobody answered within ``timeout`` seconds (default: the wire's start).
        """
        timeout = self._start if timeout is None else timeout
        if missing := ", ".join(self.unanswered(timeout)):
            raise RunError(f"{self.who}: nobody answered on {missing} within {timeout:g} s of the start")

    def unanswered(self, timeout: float) -> list[str]:
        """The links, of those declared since the last call, that still have nobody at their other end."""
        meeting, self._meeting = self._meeting, {}
        matched: set[str] = set()
        news = SimpleQueue[str]()
        for name, publisher in meeting.items():
            self._kept.append(publisher.declare_matching_listener(at_once(partial(_matched, news, name))))
            if publisher.matching_status.matching:
                news.put(name)
        end = time.monotonic() + timeout
        while len(matched) < len(meeting):
            try:
                matched.add(news.get(timeout=max(0.0, end - time.monotonic())))
            except Empty:
                break
        self._kept += meeting.values()
        return [name for name in meeting if name not in matched]

    # -- receiving --------------------------------------------------------------------------------------------------

    def get(self, timeout: float) -> tuple[Source, Frame] | None:
        """The next good frame, or None when a peer has gone (its sources say ``gone``).

        Bad frames are counted at their source, warned about once per cause, and dropped. Raises ``queue.Empty`` when
        nothing came for ``timeout`` seconds.
        """
        end = time.monotonic() + timeout  # bad frames do not put it off
        while True:
            source, data = self._queue.get(timeout=max(0.0, end - time.monotonic()))
            if isinstance(source, Member):
                self.bury(source)
                return None
            try:
                frame = source.decode(data)  # type: ignore[arg-type]
            except Rejected as e:
                self.reject(source, e.cause)
                continue
            source.last = frame[:2]
            return source, frame

    def wake(self) -> None:
        """Make a waiting ``get`` return None; safe in a signal handler."""
        self._queue.put((Member(""), None))

    def pending(self) -> bool:
        """Whether ``get`` would return at once."""
        return not self._queue.empty()

    def bury(self, member: Member) -> None:
        """Nothing will come any more from this process, or from one before it."""
        for s in self.sources:
            if s.who == member.who and s.before <= member.before:
                s.gone = True

    def reject(self, source: Source, cause: str) -> None:
        """Count a refused frame; the first of its kind is worth a line in the log."""
        source.rejected[cause] += 1
        if source.rejected[cause] == 1:
            self._warn(f"refused a frame on {source.name}: {cause}")

    def rejections(self) -> dict[str, int]:
        """How many frames were refused, by cause."""
        return dict(sum((s.rejected for s in self.sources), Counter()))
