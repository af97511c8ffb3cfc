"""A node's rounds on the wall clock: who has not answered by the deadline is missing, and the node goes on.

The plant sends a sample per tick. All rounds of a step together may wait for ``wait`` seconds from the moment in which
the step's sample arrived here; clocks of other hosts do not matter. Everything that this node hears comes through one
queue with the time of its arrival, so a wait is one timed wait on that queue, whatever it is for.

Zenoh delivers what one process sends in the order in which it was sent, so a frame that is newer than the one that is
due says that the latter will not come. And a neighbour that was waited for in vain in two steps in a row (it was
stopped, or is slow) is not waited for again before it has caught up: it costs the others two deadlines, not one a step.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from queue import Empty
from types import TracebackType
from typing import Self

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.faults import Reception, Stamp
from duio_mesh.mesh.faulty import LONG_WAY, Arrived
from duio_mesh.mesh.frames import Rejected
from duio_mesh.mesh.inbox import BACK, BEFORE, GONE, At, Inbox, Link
from duio_mesh.mesh.session import Member, Mesh, Outlet
from duio_mesh.mesh.spoiler import Spoiler
from duio_mesh.spec import NodeSpec

VAIN = 2  # steps in a row in which a neighbour is waited for until the deadline
END = 0.1  # seconds after the last step in which messages that are on their way may still come


class Clock:
    """How long the steps take, by the node's own clock."""

    def __init__(self, tick: float, wait: float, first: float) -> None:
        """Seconds per step; seconds that a step's rounds may wait; the same for step 0, with which the clock starts."""
        self._tick, self._wait, self._first = tick, wait, first
        self._begun: float | None = None  # when the sample of the present step arrived
        self.deadline = 0.0
        """Until when the present step's rounds may wait."""
        self.overruns = 0
        """Steps after the first that took longer than a tick from their sample's arrival to their end."""

    def begin(self, k: int, arrived: float) -> None:
        """The sample of step k has arrived at this time."""
        self.deadline = arrived + (self._wait if k else self._first)
        self._begun = arrived if k else None

    def end(self) -> None:
        """The step is done."""
        if self._begun is not None:
            self.overruns += time.monotonic() - self._begun > self._tick
            self._begun = None


class Realtime:
    """One node's samples and rounds: in place of ``Lockstep`` and ``Exchange``, with neighbours missing in the result.

    Faults on purpose (``spec.faults``) come on top: what the model loses or delays is neither waited for nor counted
    as late or missing, but as a fault.
    """

    def __init__(
        self,
        spec: NodeSpec,
        mesh: Mesh,
        told: Outlet,
        late: Callable[[int, Sequence[Arrived]], None],
        note: Callable[[Sequence[Array]], None],
    ) -> None:
        """Declares the links from the plant and the neighbours.

        ``late`` is called as late(k, [(stamp, vector), ...]) before the round in which older frames arrive; ``note`` as
        note([count]) after every step: how many neighbours were missing in one of its rounds at least.
        """
        self._mesh, self._late, self._note, self._patience = mesh, late, note, spec.deadline
        self._tell = Spoiler(spec, told)
        self._inbox, keys, i = Inbox(), mesh.keys, spec.id
        self._plant = Link(mesh, keys.plant(i), f"plant -> {i}", "plant", None, self._inbox)
        self._heard = {
            j: Link(mesh, keys.edge(j, i), f"edge {j} -> {i}", f"node-{j}", (j, i), self._inbox)
            for j in sorted(spec.hears)
        }
        self._source = {link: j for j, link in self._heard.items()}
        self._window = spec.window
        self._clock = Clock(spec.tick, spec.wait, spec.deadline)
        self._reception = Reception(spec.faults, spec.hears)
        self._excused: dict[Stamp, bool] = {}  # faults on purpose: frames not here yet, to be held or dropped
        self._held: dict[Stamp, Array] = {}  # ... and those that are here, on their long way
        self._overdue: list[Arrived] = []  # late frames since the last round
        self._sizes: dict[At, int] = {}  # of a vector, by (whether it was the first step, round)
        self._done = self._sampled = self._closed = BEFORE
        self._absent: set[int] = set()  # neighbours that were missing in this step
        self._expected = self._on_time = self._tardy = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        """Close the last step. What is still on its way shortly after the end of a good run counts as late."""
        end = time.monotonic() + (0.0 if error else END)
        while self._missing() and (left := end - time.monotonic()) > 0:
            self._take(left)
        self._close()

    @property
    def counts(self) -> Mapping[str, int]:
        """Frames of the in-edges, by what the fault model did to them."""
        return self._reception.counts

    def timing(self) -> dict[str, int]:
        """Messages of the neighbours by when they came, and steps that took too long."""
        return {
            "on_time": self._on_time,
            "late": self._tardy,
            "missing": self._missing(),
            "overruns": self._clock.overruns,
        }

    def _missing(self) -> int:
        return self._expected - self._on_time - self._tardy

    def noticed(self, member: Member, alive: bool) -> None:
        """A directly linked process came or went (``Mesh.watch``). Who has gone is not waited for."""
        self._inbox.put(member.who, BACK if alive else GONE)

    def sample(self, k: int, r: int, size: int) -> Array:
        """The plant's sample (size,) of step k; r is 0. Its arrival sets the deadline of the step.

        Raises RunError when it does not come within the run's deadline, or when the plant has gone.
        """
        self._close()
        end, plant = time.monotonic() + self._patience, self._plant
        while (k, r) not in plant.waiting:
            if plant.gone and not len(self._inbox):
                raise RunError(
                    f"{self._mesh.who} lost {plant.who} while waiting on {plant.name} for step {k}", (plant.who,)
                )
            if not self._take(end - time.monotonic()):
                raise RunError(
                    f"{self._mesh.who} waited {self._patience:g} s on {plant.name} for step {k}: {plant.doing()}"
                )
        arrived, vector = plant.waiting.pop((k, r))
        if vector.size != size:
            raise RunError(f"{self._mesh.who}: the plant sent {vector.size} numbers instead of {size} for step {k}")
        self._sampled = (k, r)
        self._clock.begin(k, arrived)
        return vector

    def __call__(self, k: int, r: int, vector: Array) -> dict[int, Array]:
        """Send our vector of step k, round r; those of the same round that arrive in time, in ascending order of id."""
        self._tell(k, r, vector)
        self._sizes[min(k, 1), r] = vector.size
        due, held, lost, released = self._reception.next(k, r)
        for _ in range(len(self._inbox)):  # not until it is empty: a flood must not hold us up
            self._take(0.0)
        while self._awaited(due, k, r) and (left := self._clock.deadline - time.monotonic()) > 0:
            self._take(left)
        for fate, sources in ((True, held), (False, lost)):
            for j in sources:
                self._part(Stamp(j, k, r), keep=fate)
        received = {}
        for j in due:
            vectors = self._heard[j].waiting.pop((k, r), None)
            if vectors is not None and self._fits(Stamp(j, k, r), vectors[1]):
                received[j] = vectors[1]
        self._absent.update(j for j in due if j not in received)
        self._expected += len(due)
        self._on_time += len(received)
        self._done = (k, r)
        self._hand_over(k, released)
        return received

    # -- what arrives -----------------------------------------------------------------------------------------------

    def _take(self, timeout: float) -> bool:
        """Take in the next thing that arrives; False when nothing did in time."""
        try:
            got = self._inbox.get(timeout)
        except Empty:
            return False
        if got is None:
            return True
        link, arrived, data = got
        try:
            k, r, vector = link.decode(data)
        except Rejected as e:
            self._mesh.reject(link, e.cause)
            return True
        done = self._sampled if link is self._plant else self._done
        if (k, r) <= link.newest:
            self._mesh.reject(link, "seen before")
        elif k - done[0] > self._window + 1 or len(link.waiting) >= LONG_WAY:
            self._mesh.reject(link, "too far ahead")
        else:
            link.last = (k, r)
            if k >= self._sampled[0] - 1:
                link.vain = 0
            if (k, r) > done:
                link.waiting[k, r] = (arrived, vector)
            elif link is not self._plant:
                self._past_due(Stamp(self._source[link], k, r), vector)
        return True

    def _past_due(self, stamp: Stamp, vector: Array) -> None:
        kept = self._excused.pop(stamp, None)
        if kept:
            self._held[stamp] = vector
        elif kept is None and self._fits(stamp, vector):
            self._tardy += 1
            self._overdue.append((stamp, vector))

    def _awaited(self, due: Sequence[int], k: int, r: int) -> bool:
        """Whether one of these neighbours may still answer in time."""
        links = (self._heard[j] for j in due)
        return any(link.newest < (k, r) and link.vain < VAIN and not link.gone for link in links)

    def _fits(self, stamp: Stamp, vector: Array) -> bool:
        """Whether a vector has the size of our own of that round; one that has not is refused."""
        size = self._sizes.get((min(stamp.k, 1), stamp.r))
        if vector.size != size:
            self._mesh.reject(self._heard[stamp.source], f"{vector.size} numbers instead of {size}")
        return vector.size == size

    # -- faults on purpose ------------------------------------------------------------------------------------------

    def _part(self, stamp: Stamp, *, keep: bool) -> None:
        """The model loses this frame or (keep) holds it back, be it here already or not."""
        got = self._heard[stamp.source].waiting.pop((stamp.k, stamp.r), None)
        if got is None:
            self._excused[stamp] = keep
        elif keep and self._fits(stamp, got[1]):
            self._held[stamp] = got[1]

    def _hand_over(self, k: int, released: Sequence[Stamp]) -> None:
        """Give the observer what is late: by itself, or because the model lets go of it now."""
        arrived, self._overdue = self._overdue, []
        for stamp in released:
            if stamp in self._held:
                arrived.append((stamp, self._held.pop(stamp)))
            elif self._excused.pop(stamp, None):  # really late as well: from now on like any other
                self._expected += 1
        if arrived:
            self._late(k, sorted(arrived, key=lambda a: (a[0].k, a[0].r, a[0].source)))

    # -- the ends of steps ------------------------------------------------------------------------------------------

    def _close(self) -> None:
        """The present step is done, if there is one."""
        if self._sampled == self._closed:
            return
        self._closed = self._sampled
        self._clock.end()
        for j in self._absent:
            self._heard[j].vain += self._heard[j].newest < (self._done[0], 0)
        self._note([np.array([len(self._absent)], dtype=np.float64)])
        self._absent.clear()
        while self._excused and next(iter(self._excused)).k < self._done[0] - self._window:
            del self._excused[next(iter(self._excused))]
