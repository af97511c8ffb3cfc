"""Two or three peers in one process, over real Zenoh on loopback."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest

from duio_mesh.errors import RunError
from duio_mesh.mesh import Encoder, Mesh
from duio_mesh.mesh.lockstep import Line, Lockstep
from duio_mesh.spec import Wire

pytestmark = pytest.mark.mesh


def free_ports(count: int) -> list[str]:
    """Endpoints that were free a moment ago."""
    held = [socket.socket() for _ in range(count)]
    for s in held:
        s.bind(("127.0.0.1", 0))
    endpoints = [f"tcp/127.0.0.1:{s.getsockname()[1]}" for s in held]
    for s in held:
        s.close()
    return endpoints


@pytest.fixture
def line() -> Iterator[tuple[Mesh, Mesh, Mesh]]:
    """Three peers connected 1 - 2 - 3."""
    a, b, c = free_ports(3)
    with ExitStack() as stack:
        yield (
            stack.enter_context(Mesh(Wire("t", (a,), ()), "node-1")),
            stack.enter_context(Mesh(Wire("t", (b,), (a,)), "node-2")),
            stack.enter_context(Mesh(Wire("t", (c,), (b,)), "node-3")),
        )


def test_frames_arrive_in_order_after_the_start_barrier(line: tuple[Mesh, Mesh, Mesh]) -> None:
    one, two, _ = line
    source = Line(two, two.keys.edge(1, 2), "edge 1 -> 2", "node-1", (1, 2), 1000)
    outlet = one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    one.meet(10)
    for k in range(200):
        outlet.send(k, 0, np.array([float(k), -1.0]))
    with Lockstep(two, 5.0) as steps:
        for k in range(200):
            assert steps.take(source, k, 0, 2)[0] == k
    assert outlet.frames == 200
    assert source.last == (199, 0)
    assert two.rejections() == {}


def test_the_barrier_names_the_link_that_nobody_answers(line: tuple[Mesh, Mesh, Mesh]) -> None:
    one, _, _ = line
    one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    with pytest.raises(RunError, match=r"node-1: nobody answered on edge 1 -> 2 within 0.2 s"):
        one.meet(0.2)


def test_peers_do_not_forward_so_a_non_neighbour_hears_nothing(line: tuple[Mesh, Mesh, Mesh]) -> None:
    """Node 3 is not linked to node 1: whatever it subscribes to, 1's frames on 1 -> 2 end at 2."""
    one, two, three = line
    three.hear(three.keys.edge(1, 2), "eavesdropping", "node-1")
    source = Line(two, two.keys.edge(1, 2), "edge 1 -> 2", "node-1", (1, 2), 1000)
    outlet = one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    marker = two.speak([(two.keys.edge(2, 3), "edge 2 -> 3", (2, 3))])
    marked = three.hear(three.keys.edge(2, 3), "edge 2 -> 3", "node-2", ready=(2, 3))
    one.meet(10)
    two.meet(10)
    for k in range(50):
        outlet.send(k, 0, np.zeros(3))
    with Lockstep(two, 5.0) as steps:
        assert [steps.take(source, k, 0, 3).size for k in range(50)] == [3] * 50
    marker.send(0, 0, np.ones(1))  # what 2 sends does reach 3: after it, 1's frames would have been there
    seen = set()
    while marked not in seen:
        got = three.get(5.0)
        assert got
        seen.add(got[0])
    assert seen == {marked}
    assert not three.pending()


def test_a_wait_that_passes_its_deadline_says_edge_step_round_and_what_the_other_side_did(
    line: tuple[Mesh, Mesh, Mesh],
) -> None:
    one, two, _ = line
    source = Line(two, two.keys.edge(1, 2), "edge 1 -> 2", "node-1", (1, 2), 1000)
    outlet = one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    one.meet(10)
    outlet.send(0, 0, np.zeros(2))
    with Lockstep(two, 0.3) as steps:
        steps.take(source, 0, 0, 2)
        with pytest.raises(RunError) as e:
            steps.take(source, 1, 0, 2)
    assert str(e.value) == "node-2 waited 0.3 s on edge 1 -> 2 for step 1, round 0: it last sent step 0, round 0"


def test_a_peer_that_goes_is_noticed_long_before_the_deadline(line: tuple[Mesh, Mesh, Mesh]) -> None:
    one, two, _ = line
    source = Line(two, two.keys.edge(1, 2), "edge 1 -> 2", "node-1", (1, 2), 1000)
    outlet = one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    steps = Lockstep(two, 60.0)
    one.watch()
    two.watch(steps.noticed)
    one.meet(10)
    for k in range(3):
        outlet.send(k, 0, np.zeros(2))
    threading.Timer(0.2, one._session.close).start()
    with steps:
        for k in range(3):
            assert steps.take(source, k, 0, 2).size == 2  # what it sent before it went still counts
        with pytest.raises(RunError, match="node-2 lost node-1 while waiting on edge 1 -> 2 for step 3, round 0"):
            steps.take(source, 3, 0, 2)


def test_frames_out_of_step_or_of_the_wrong_size_are_counted_and_never_used(line: tuple[Mesh, Mesh, Mesh]) -> None:
    one, two, _ = line
    warnings: list[str] = []
    two._warn = warnings.append
    source = Line(two, two.keys.edge(1, 2), "edge 1 -> 2", "node-1", (1, 2), 20)
    outlet = one.speak([(one.keys.edge(1, 2), "edge 1 -> 2", (1, 2))])
    one.meet(10)
    send, good = outlet._publishers[0].put, Encoder("t", "node-1")
    send(b"noise")
    send(Encoder("t", "node-9")(0, 0, np.zeros(2)))  # somebody else's
    send(Encoder("u", "node-1")(0, 0, np.zeros(2)))  # an earlier run's
    send(good(70, 0, np.zeros(2)))  # too far ahead
    send(good(0, 0, np.zeros(5)))  # wrong shape
    for k in range(3):
        send(good(k, 0, np.full(2, float(k))))
        send(good(k, 0, np.full(2, 99.0)))  # a repetition
    with Lockstep(two, 5.0) as steps:
        assert [steps.take(source, k, 0, 2)[0] for k in range(3)] == [0.0, 1.0, 2.0]
    refused = two.rejections()
    assert refused["not from the expected source, run and version"] == 3  # noise, another's, another run's
    assert refused["too far ahead"] == 1
    assert refused["5 numbers instead of 2"] == 1
    assert refused["seen before"] >= 2
    assert len(warnings) == len(refused)  # one line per cause, not per frame


def test_an_endpoint_in_use_is_an_error_at_once() -> None:
    (endpoint,) = free_ports(1)
    with (
        Mesh(Wire("t", (endpoint,), ()), "node-1"),
        pytest.raises(RunError, match="node-2 could not open its links"),
        Mesh(Wire("t", (endpoint,), ()), "node-2"),
    ):
        pass


def test_scouting_is_off(line: tuple[Mesh, Mesh, Mesh]) -> None:
    one, two, three = line
    peers = [{str(z) for z in m._session.info.peers_zid()} for m in line]
    zids = [str(m._session.info.zid()) for m in (one, two, three)]
    assert peers == [{zids[1]}, {zids[0], zids[2]}, {zids[1]}]


def test_a_frame_that_was_kept_ends_its_wait(line: tuple[Mesh, Mesh, Mesh]) -> None:
    """Else the watchdog goes on about it, and the messages say that nothing was ever sent."""
    a, b, _ = line
    told = a.speak([(a.keys.edge(1, 2), "1 -> 2", (1, 2))])
    heard = Line(b, b.keys.edge(1, 2), "1 -> 2", "node-1", (1, 2), 4)
    a.meet()
    lockstep = Lockstep(b, 5.0)
    with lockstep:
        for k in (1, 0):
            told.send(k, 0, np.ones(1))
        for k in (0, 1):
            lockstep.take(heard, k, 0, 1)
    assert lockstep._at is None
    assert heard.last == (1, 0)
