"""Everything that one node hears and tells, and who of its neighbours is there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial

from duio_mesh.arrays import Array
from duio_mesh.journal import MISSING, Journal, missing
from duio_mesh.mesh import Member, Mesh
from duio_mesh.mesh.faulty import LONG_WAY, Arrived, FaultyExchange
from duio_mesh.mesh.lockstep import Ended, Exchange, Line, LinkLost, Lockstep
from duio_mesh.mesh.realtime import Realtime
from duio_mesh.mesh.rejoin import HELLO, JOINED, Admission, ask, come_back
from duio_mesh.mesh.session import Ready
from duio_mesh.observers import make_observer
from duio_mesh.observers.absence import Late, greeting, part_with, start_again, take_late, welcome
from duio_mesh.process import Report
from duio_mesh.spec import PATIENCE, NodeSpec, blocks
from duio_mesh.tape import Tape

RETURN = 1.0  # seconds in which a neighbour answers a process that comes back, unless it is gone itself


class Links:
    """A node's observer with its lines to the plant, the neighbours and the recorder."""

    def __init__(self, spec: NodeSpec, mesh: Mesh, tape: Tape, report: Report) -> None:
        i, keys, window = spec.id, mesh.keys, spec.window
        room = LONG_WAY if spec.without else 0
        self.mesh, self.tape, self._spec, self._report = mesh, tape, spec, report
        self.observer = tape.follow(make_observer(spec))
        edges: list[tuple[str, str, Ready | None]] = [(keys.edge(i, j), f"edge {i} -> {j}", (i, j)) for j in spec.tells]
        self.told = mesh.speak(edges, drop=spec.tick > 0)  # in real time nobody waits for who does not listen
        self.credit = mesh.speak([(keys.credit(i), f"{i} -> plant", None)])
        self.trace = mesh.speak(
            [(keys.trace(i), f"{i} -> recorder", (i, "recorder") if spec.kept else None)], drop=not spec.kept
        )
        self.back: dict[int, int] = {}  # nodes that come back at this step, and how many processes of each there were
        self.heard: dict[int, Line] = {}
        self.exchange: Exchange | FaultyExchange | Realtime
        self.lockstep: Lockstep | Realtime
        self.gaps: AbstractContextManager[object] = nullcontext()
        if spec.tick:
            self.gaps = gaps = Journal(str(missing(spec.output)) if spec.output else "", 1, self.trace, kind=MISSING)
            self.lockstep = self.exchange = clock = Realtime(spec, mesh, self.told, self.late, gaps.add)
            self._sample: Callable[[int, int, int], Array] = clock.sample
            return
        times = 1 if spec.on_loss == "stop" else PATIENCE
        self.lockstep = lockstep = Lockstep(mesh, spec.deadline, report, times)
        self._plant = Line(mesh, keys.plant(i), f"plant -> {i}", "plant", None, window)
        self._plant.patient = spec.outside
        self._sample = partial(lockstep.take, self._plant)
        self.heard = {
            j: Line(mesh, keys.edge(j, i), f"edge {j} -> {i}", f"node-{j}", (j, i), window, room) for j in spec.hears
        }
        self.exchange = Exchange(lockstep, self.told, self.heard)
        if spec.without:  # messages can be missing
            self.exchange = FaultyExchange(spec, lockstep, self.told, self.heard, self)

    def begin(self) -> int:
        """Begin with everybody else, at step 0. Raises RunError when somebody is not there."""
        self.mesh.meet()
        self._greet_the_plant()
        self.mesh.meet()
        self._report("ready")
        return 0

    def _greet_the_plant(self) -> None:
        """Let the plant begin, as far as it is for us. After the neighbours: one that needs nobody may soon be gone."""
        i = self._spec.id
        self.mesh.announce(("plant", i))
        self.mesh.expect(f"{i} -> plant", (i, "plant"))

    def faults(self) -> dict[str, int]:
        """How many frames met which fault."""
        return {} if isinstance(self.exchange, Exchange) else dict(self.exchange.counts)

    def timing(self) -> dict[str, int]:
        """In real time: how many messages were in time, late and missing, and how many steps took too long."""
        return self.exchange.timing() if isinstance(self.exchange, Realtime) else {}

    def samples(self, first: int) -> Iterator[Array]:
        """[y_i(k); u_i(k)] for k = first, first + 1, ...: the plant sends a few steps in one frame."""
        spec, size = self._spec, self._spec.p + self._spec.m
        for block in blocks(first, spec.steps, spec.block, spec.breaks):
            k, count = block.start, len(block)
            try:
                rows = self._sample(k, 0, count * size).reshape(count, size)
            except Ended:
                return
            if not spec.tick and (joined := self._plant.waiting.pop((k, JOINED), None)) is not None:
                self.back = come_back(joined)
            yield from rows

    def late(self, k: int, arrived: Sequence[Arrived]) -> None:
        """Give the observer the older frames that arrive in step k."""
        take_late(self.observer, [Late(stamp.source, k - stamp.k, stamp.r, vector) for stamp, vector in arrived])

    def lost(self, j: int, k: int, r: int, why: str) -> None:
        """Go on without neighbour j."""
        part_with(self.observer, j)
        if why:
            self._report("lost", node=j, k=k, r=r, text=why)

    def take_back(self, k: int) -> None:
        """Go on with the neighbours that come back at step k, and tell them where we are."""
        spec, back, self.back = self._spec, self.back, {}
        for j, before in back.items():
            near = j != spec.id and (j in spec.hears or j in spec.tells)
            if not near or not self.mesh.await_birth(Member(f"node-{j}", before), RETURN):
                continue  # gone again already: it stays lost
            if j in spec.tells and spec.warm and k:
                self.told.send_to(spec.tells.index(j), k, HELLO, greeting(self.observer.estimate()))
            if j in spec.hears and isinstance(self.exchange, FaultyExchange):
                self.heard[j].expect(before)
                self.exchange.welcome(j, k)
                welcome(self.observer, j)
                self._report("joined", node=j, k=k)

    def rejoin(self) -> int:
        """Take the place of a lost process (mesh/rejoin.py); the step to begin with.

        Raises RunError when the plant is lost or silent.
        """
        spec, lockstep = self._spec, self.lockstep
        assert isinstance(lockstep, Lockstep)  # noqa: S101  (nobody comes back in real time)
        self._greet_the_plant()
        self.mesh.unanswered(RETURN)  # who does not answer is gone itself
        self._report("ready")
        admission = ask(lockstep, self._plant, self.credit, spec.id, spec.incarnation)
        k = lockstep.first = admission.first
        self.observer = self.tape.follow(make_observer(replace(spec, steps=spec.steps - k)), k, spec.incarnation)
        told = [x for j in self.heard if (x := self._greeted(lockstep, j, admission)) is not None]
        start_again(self.observer, told, admission.data, spec.p)
        self._report("back", k=k, told_by=len(told))
        return k

    def _greeted(self, lockstep: Lockstep, j: int, admission: Admission) -> Array | None:
        """Neighbour j's greeting, if it has one for us; from now on it is expected, or known to be gone."""
        exchange, line, k = self.exchange, self.heard[j], admission.first
        assert isinstance(exchange, FaultyExchange)  # noqa: S101  (spec.on_loss is restart)
        if not exchange.expects(j, k):
            return None  # not there, as planned
        try:
            line.expect(self._process_of(j, admission))
            if self._spec.warm and admission.data.size and j not in admission.joined:
                return lockstep.take(line, k, HELLO, self._spec.n + 1)
        except LinkLost as e:
            exchange.lose(j, k, 0, str(e))
        return None

    def _process_of(self, j: int, admission: Admission) -> int:
        """How many processes of node j there were before the one that is there now. Raises LinkLost: nobody is."""
        who, there = f"node-{j}", None
        if j in admission.joined:
            member = Member(who, admission.joined[j])
            there = member if self.mesh.await_birth(member, RETURN) else None
        elif j not in admission.away:
            there = self.mesh.await_somebody(who, RETURN)
        if there is None:
            raise LinkLost(f"{who} was gone when node-{self._spec.id} came back")
        return there.before
