"""The rounds of a realtime node without a network: what arrives when is decided here, frame by frame."""

from __future__ import annotations

import threading
from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.arrays import Array
from duio_mesh.errors import RunError
from duio_mesh.faults import Incoming, Rule
from duio_mesh.mesh.faulty import Arrived
from duio_mesh.mesh.frames import Encoder
from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.realtime import Realtime
from duio_mesh.spec import NodeSpec

RUN, SIZE = "run", 3


class Process(str):
    """A process by its name, which is all that matters here."""

    @property
    def who(self) -> str:
        return str(self)


class Sample:
    """What Zenoh hands to a subscriber."""

    def __init__(self, data: bytes) -> None:
        self.payload = self
        self.to_bytes = lambda: data


class Network:
    """Stands in for ``Mesh`` and ``Outlet``: keeps what is sent, and delivers what it is told to."""

    def __init__(self) -> None:
        self.keys, self.who, self.sources = Keys(RUN), "node-1", list[Any]()
        self.callbacks: dict[str, Any] = {}
        self.refused: Counter[str] = Counter()
        self.sent: list[tuple[int, int]] = []

    def subscribe(self, key: str, handler: Any, ready: Any) -> None:
        self.callbacks[key] = handler.callback

    def reject(self, source: Any, cause: str) -> None:
        self.refused[cause] += 1

    def send_each(self, k: int, r: int, vector: Array, spoil: Any) -> None:
        self.sent.append((k, r))

    def sample(self, k: int, numbers: int = 2) -> None:
        data = Encoder(RUN, "plant")(k, 0, np.full(numbers, float(k)))
        self.callbacks[self.keys.plant(1)](Sample(data))

    def frame(self, j: int, k: int, r: int = 0, size: int = SIZE) -> None:
        data = Encoder(RUN, f"node-{j}")(k, r, np.full(size, 100.0 * k + 10 * r + j))
        self.callbacks[self.keys.edge(j, 1)](Sample(data))


class Node:
    """Node 1, which hears 2 and 3."""

    def __init__(self, wait: float = 0.0, faults: Incoming | None = None, window: int = 50) -> None:
        spec = NodeSpec(
            id=1, method="lmi", n=SIZE, p=2, m=0, matrices={}, options={}, hears={2: 1.0, 3: 1.0}, tells=(2, 3),
            steps=1000, deadline=0.2, window=window, credit=1, block=1, batch=1, tick=2 * wait or 1.0, wait=wait,
            without="skip", **({"faults": faults} if faults else {}),
        )  # fmt: skip
        self.network = Network()
        self.late: list[tuple[int, Arrived]] = []
        self.gaps: list[float] = []
        network: Any = self.network
        self.realtime = Realtime(
            spec, network, network, lambda k, got: self.late.extend((k, a) for a in got), self._note
        )
        self.vector = np.zeros(SIZE)

    def _note(self, parts: Any) -> None:
        self.gaps.append(float(parts[0][0]))

    def step(self, k: int, rounds: int = 1) -> list[dict[int, float]]:
        """Sample k is there: the neighbours' vectors by round, as their first numbers."""
        self.network.sample(k)
        self.realtime.sample(k, 0, 2)
        received = [self.realtime(k, r, self.vector) for r in range(rounds)]
        return [{j: float(v[0]) for j, v in got.items()} for got in received]

    def first(self) -> None:
        """Step 0, in which everybody is waited for."""
        self.network.frame(2, 0)
        self.network.frame(3, 0)
        assert self.step(0) == [{2: 2.0, 3: 3.0}]


def test_what_came_before_the_deadline_counts_and_what_comes_later_is_handed_over() -> None:
    node = Node()
    node.first()
    node.network.frame(3, 1)
    assert node.step(1) == [{3: 103.0}]
    node.network.frame(2, 1)  # late
    node.network.frame(2, 2)
    node.network.frame(3, 2)
    assert node.step(2) == [{2: 202.0, 3: 203.0}]
    (at, (stamp, vector)), *more = node.late
    assert (at, stamp, vector[0], more) == (2, (2, 1, 0), 102.0, [])
    with node.realtime:
        pass
    assert node.gaps == [0, 1, 0]
    assert node.realtime.timing() == {"on_time": 5, "late": 1, "missing": 0, "overruns": 0}
    assert node.network.sent == [(0, 0), (1, 0), (2, 0)]


def test_the_wait_ends_with_the_last_answer_not_with_the_deadline() -> None:
    node = Node(wait=30.0)  # the test's own time limit would end a wait of that
    node.first()
    threading.Timer(0.05, lambda: (node.network.frame(2, 1), node.network.frame(3, 1))).start()
    assert node.step(1) == [{2: 102.0, 3: 103.0}]


def test_a_neighbour_that_is_gone_a_frame_that_was_dropped_and_one_that_is_far_behind_are_not_waited_for() -> None:
    node = Node(wait=30.0)
    node.first()
    node.network.frame(2, 2)  # newer than the frame that is due: that one was dropped on the way
    node.realtime.noticed(Process("node-3"), alive=False)
    assert node.step(1) == [{}]
    assert node.step(2) == [{2: 202.0}]
    node.realtime.noticed(Process("node-3"), alive=True)  # its newest frame is of step 0
    node.network.frame(2, 3)  # and two deadlines have passed without any
    assert node.step(3) == [{2: 302.0}]
    threading.Timer(0.05, lambda: [node.network.frame(3, k) for k in (1, 2, 3, 4)]).start()
    node.network.frame(2, 4)
    node.network.frame(3, 3)  # nearly back: now it is waited for
    assert node.step(4) == [{2: 402.0, 3: 403.0}]


def test_a_single_lost_frame_does_not_end_the_waiting_for_its_sender() -> None:
    node = Node(wait=0.05)
    node.first()
    node.network.frame(3, 1)
    assert node.step(1) == [{3: 103.0}]
    node = Node(wait=30.0, faults=Incoming(1, 0, {2: (Rule(0, corrupt=1.0, during=(1, 2)),)}))
    node.first()
    node.network.frame(3, 1)
    assert node.step(1) == [{3: 103.0}]
    threading.Timer(0.05, lambda: (node.network.frame(2, 2), node.network.frame(3, 2))).start()
    assert node.step(2) == [{2: 202.0, 3: 203.0}]


def test_a_deadline_holds_for_all_rounds_together_and_only_once() -> None:
    node = Node(wait=0.05)
    node.first()
    assert node.step(1, rounds=200) == [{}] * 200  # 200 deadlines of their own would be 10 s
    assert node.realtime.timing()["missing"] == 400


def test_bad_frames_are_refused_and_counted() -> None:
    node = Node(window=5)
    node.first()
    node.network.frame(2, 1)
    node.network.frame(2, 1)
    node.network.frame(3, 1, size=SIZE + 1)
    node.network.frame(3, 9)
    node.network.callbacks[node.network.keys.edge(3, 1)](Sample(b"noise"))
    assert node.step(1) == [{2: 102.0}]
    assert node.network.refused == {
        "seen before": 1,
        f"{SIZE + 1} numbers instead of {SIZE}": 1,
        "too far ahead": 1,
        "not from the expected source, run and version": 1,
    }


def test_a_plant_that_is_lost_or_silent_ends_the_node() -> None:
    node = Node()
    with pytest.raises(RunError, match=r"waited 0.2 s on plant -> 1 for step 0: it sent nothing yet"):
        node.realtime.sample(0, 0, 2)
    node.network.sample(0)
    node.realtime.noticed(Process("plant"), alive=False)
    assert node.realtime.sample(0, 0, 2).tolist() == [0.0, 0.0]  # what it sent before it went still counts
    with pytest.raises(RunError, match=r"lost plant while waiting on plant -> 1 for step 1"):
        node.realtime.sample(1, 0, 2)


def test_what_the_fault_model_takes_is_neither_late_nor_missing() -> None:
    rules = {2: (Rule(0, loss=1.0),), 3: (Rule(1, delay_steps=(2, 2)),)}
    node = Node(faults=Incoming(1, 0, rules))
    for k in range(6):
        if k % 2:  # the model's lost and late frames may arrive before or after their step
            node.network.frame(2, k), node.network.frame(3, k)
        assert node.step(k) == [{}]
        if not k % 2:
            node.network.frame(2, k), node.network.frame(3, k)
    assert [(at, stamp.source, stamp.k) for at, (stamp, _) in node.late] == [(2, 3, 0), (3, 3, 1), (4, 3, 2), (5, 3, 3)]
    assert node.realtime.timing() == {"on_time": 0, "late": 0, "missing": 0, "overruns": 0}
    assert node.realtime.counts["lost"] == node.realtime.counts["late"] == 6


@settings(deadline=None, derandomize=True, max_examples=60)
@given(st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), min_size=8, max_size=8), st.data())
def test_every_frame_is_counted_exactly_once(delays: list[tuple[int, int]], data: st.DataObject) -> None:
    """Frames of step k from neighbour 2 and 3 are on their way for so many steps; 8 never arrives."""
    node = Node()
    node.first()
    links = {2: [d for d, _ in delays], 3: [d for _, d in delays]}
    arrive: dict[int, list[tuple[int, int]]] = {}
    on_time = late = 0
    for j, delay in links.items():
        reached = 0
        for k, d in enumerate(delay, start=1):
            if d == 8:
                continue
            reached = max(reached, k + d)  # a link keeps the order
            arrive.setdefault(reached, []).append((j, k))
            on_time += reached == k
            late += k < reached <= len(delays)
    for k in range(1, len(delays) + 1):
        due = arrive.get(k, [])
        order = data.draw(st.permutations([2, 3]))
        for j in order:
            for source, step in due:
                if source == j:
                    node.network.frame(j, step)
        expected = {j: 100.0 * k + j for j, step in sorted(due) if step == k}
        assert node.step(k) == [expected]
    assert [(s.source, s.k) for _, (s, _) in node.late] == [
        (j, step)
        for k in range(1, len(delays) + 1)
        for step, j in sorted((step, j) for j, step in arrive.get(k, []) if step < k)
    ]
    total = 2 * len(delays)
    counts = {"on_time": on_time + 2, "late": late, "missing": total - on_time - late, "overruns": 0}
    assert node.realtime.timing() == counts
    assert not node.network.refused
