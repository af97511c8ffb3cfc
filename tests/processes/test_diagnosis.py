"""Who waits for whom, and who is to blame, from what processes have said: no run, plain ``Process`` objects."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence

import pytest

from duio_mesh.diagnosis import Process, culprits, first_cause, in_words, owing, roots, some

NOW = 1000.0  # seconds


def waiting(waits: Mapping[str, Sequence[str]], *others: str) -> dict[str, Process]:
    """Processes of which some wait: since five seconds, in step 7, the nodes on an edge, the plant on nobody's."""
    found = {who: Process(who) for who in (*waits, *others)}
    for process in found.values():
        process.hear({"event": "started", "pid": os.getpid()}, 0.0)  # running, like this one
    for who, on in waits.items():
        link = "" if who == "plant" else f"edge {on[0][5:]} -> {who[5:]}"
        found[who].hear({"event": "waiting", "on": on, "link": link, "k": 7, "r": 1, "waited": 5.0}, NOW)
    return found


def names(processes: Sequence[Process]) -> list[str]:
    return [p.who for p in processes]


@pytest.fixture
def stopped() -> Iterator[int]:
    """The pid of a process that really is stopped."""
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    child.send_signal(signal.SIGSTOP)
    os.waitpid(child.pid, os.WUNTRACED)
    yield child.pid
    child.kill()
    child.communicate()


def test_a_frozen_node_in_a_ring_is_the_root(stopped: int) -> None:
    """It has said nothing, its neighbours wait for it, theirs for them, and the plant for whoever is slowest."""
    ring = waiting(
        {"plant": ["node-3"], "node-1": ["node-2"], "node-2": ["node-3"], "node-4": ["node-3"], "node-5": ["node-4"]},
        "node-3",
        "recorder",
    )
    assert names(roots(ring)) == ["node-3"]
    assert in_words(ring) == (
        "plant waits for node-3 (step 7); node-1 waits for node-2 (edge 2 -> 1, step 7, round 1); "
        "node-2 waits for node-3 (edge 3 -> 2, step 7, round 1); "
        "node-4 waits for node-3 (edge 3 -> 4, step 7, round 1); "
        "node-5 waits for node-4 (edge 4 -> 5, step 7, round 1)"
    )
    ring["node-3"].pid = stopped
    assert in_words(ring).endswith("; node-3 is stopped")
    assert first_cause(ring) == "node-3 is stopped"


def test_a_chain_has_its_end_as_root_and_whoever_moves_waits_no_more() -> None:
    chain = waiting({"node-1": ["node-2"], "node-2": ["node-3"], "node-3": ["plant"]}, "plant")
    assert names(roots(chain)) == ["plant"]
    chain["node-3"].hear({"event": "moving"}, NOW)
    assert names(roots(chain)) == ["node-3"]
    chain["node-2"].hear({"event": "exit", "code": -9}, NOW)
    assert names(roots(chain)) == ["node-2"]
    chain["node-2"].there = False  # the others go on without it
    assert roots(chain) == []
    assert in_words(chain) == "node-1 waits for node-2 (edge 2 -> 1, step 7, round 1)"


def test_a_gateway_is_the_plant_to_the_others() -> None:
    outside = waiting({"node-1": ["plant"]}, "gateway")
    assert names(roots(outside)) == ["gateway"]


def test_a_cycle_has_no_root_unless_one_in_it_only_thinks_that_it_waits(stopped: int) -> None:
    cycle = waiting({"node-1": ["node-2"], "node-2": ["node-3"], "node-3": ["node-1"]})
    assert roots(cycle) == []
    assert culprits(cycle, 1.0, NOW) == []
    cycle["node-2"].pid = os.getpid()  # a process like any other
    assert roots(cycle) == []
    cycle["node-2"].pid = stopped
    assert names(roots(cycle)) == ["node-2"]
    assert in_words(cycle).endswith("node-3 waits for node-1 (edge 1 -> 3, step 7, round 1); node-2 is stopped")
    [(culprit, others)] = culprits(cycle, 1.0, NOW)
    assert (culprit.who, others) == ("node-2", ["node-1", "node-2", "node-3"])


def test_a_plant_that_waits_for_many_names_two() -> None:
    many = waiting({"plant": [f"node-{i}" for i in range(1, 65)]}, *(f"node-{i}" for i in range(1, 65)))
    assert in_words(many) == "plant waits for node-1, node-2 and 62 more (step 7)"
    assert [some([f"n{i}" for i in range(count)]) for count in (1, 2, 3, 4)] == [
        "n0",
        "n0 and n1",
        "n0 and n1 and n2",
        "n0, n1 and 2 more",
    ]


def test_of_many_waits_those_for_the_cause_come_first(stopped: int) -> None:
    """64 nodes in a ring, node 40 frozen: everybody waits sooner or later, each for the one nearer to it."""
    waits = {f"node-{i}": [f"node-{i + (1 if i < 40 else -1)}"] for i in range(9, 65) if i != 40}
    many = waiting(waits, "node-40")
    many["node-40"].pid = stopped
    assert in_words(many, 2) == (
        "node-39 waits for node-40 (edge 40 -> 39, step 7, round 1); "
        "node-41 waits for node-40 (edge 40 -> 41, step 7, round 1); 53 more wait; node-40 is stopped"
    )


def test_only_a_node_that_kept_others_waiting_too_long_is_a_culprit() -> None:
    ring = waiting({"plant": ["node-2"], "node-1": ["node-2"], "node-3": ["plant"]}, "node-2")
    assert [(p.who, others) for p, others in culprits(ring, 4.9, NOW)] == [("node-2", ["plant", "node-1", "node-3"])]
    assert culprits(ring, 5.1, NOW) == []
    ring["node-2"].code = -9  # known to be dead
    assert culprits(ring, 4.9, NOW) == []
    ring["node-2"].code, ring["node-2"].waits = None, ring["node-3"].waits  # it waits for the plant, that for it
    assert culprits(ring, 4.9, NOW) == []
    plant = waiting({"node-1": ["plant"]}, "plant")
    assert names(roots(plant)) == ["plant"]
    assert culprits(plant, 4.9, NOW) == [], "nobody replaces a plant"


def test_a_node_for_which_only_the_plant_waits_has_time_to_say_that_it_waits_itself(stopped: int) -> None:
    """The plant waits for all alike; a neighbour's wait is for this very node. Who is stopped will not say anything."""
    plants = waiting({"plant": ["node-1", "node-2"]}, "node-1", "node-2")
    assert culprits(plants, 2.6, NOW) == []
    assert [p.who for p, _ in culprits(plants, 2.4, NOW)] == ["node-1", "node-2"]
    plants["node-2"].pid = stopped
    assert [p.who for p, _ in culprits(plants, 2.6, NOW)] == ["node-2"]
    plants["node-1"].hear(
        {"event": "waiting", "on": ["node-2"], "link": "edge 2 -> 1", "k": 7, "r": 1, "waited": 0.6}, NOW
    )
    assert [p.who for p, _ in culprits(plants, 2.4, NOW)] == ["node-2"]


def test_a_process_that_has_just_taken_a_place_is_not_blamed_for_the_one_before() -> None:
    ring = waiting({"node-1": ["node-2"], "node-3": ["node-2"]})
    ring["node-2"] = Process("node-2")
    assert culprits(ring, 1.0, NOW) == []  # ordered, but not yet started
    ring["node-2"].hear({"event": "started", "pid": os.getpid()}, NOW - 0.9)
    assert culprits(ring, 1.0, NOW) == []
    assert [p.who for p, _ in culprits(ring, 1.0, NOW + 0.2)] == ["node-2"]


def test_a_node_that_has_just_been_freed_is_not_blamed_by_those_who_have_not_heard_of_it_yet() -> None:
    """3 was frozen, 2 waited for it and 1 for 2; 3 is dead now, 2 has said that it goes on, 1 has not yet."""
    chain = waiting({"node-1": ["node-2"], "node-2": ["node-3"]}, "node-3")
    chain["node-3"].hear({"event": "exit", "code": -9}, NOW)
    chain["node-2"].hear({"event": "moving"}, NOW)
    assert culprits(chain, 1.0, NOW + 0.1) == []
    assert [p.who for p, _ in culprits(chain, 1.0, NOW + 1.1)] == ["node-2"]


def test_who_is_stopped_is_said_even_when_nobody_waits_for_it(stopped: int) -> None:
    run = {who: Process(who) for who in ("plant", "node-1")}
    run["plant"].hear({"event": "started", "pid": stopped}, NOW)
    assert in_words(run) == ""
    assert first_cause(run) == "plant is stopped"


def test_the_first_cause_is_the_killed_then_the_failed_then_those_who_lost_them() -> None:
    run = {who: Process(who) for who in ("plant", "node-1", "node-2", "node-3", "recorder")}
    assert first_cause(run) == ""
    run["node-1"].hear({"event": "failed", "text": "node-1 lost node-2", "lost": ["node-2"]}, NOW)
    assert names(owing(run)) == ["node-2"]
    run["node-3"].hear({"event": "failed", "text": "node-3: the estimate overflowed", "lost": []}, NOW)
    assert first_cause(run) == "node-3: the estimate overflowed; node-1 lost node-2"
    run["node-2"].hear({"event": "exit", "code": -9}, NOW)
    assert owing(run) == []
    run["recorder"].hear({"event": "exit", "code": -15}, NOW)
    killed = "node-2 was killed by SIGKILL"
    assert first_cause(run) == f"{killed}; node-3: the estimate overflowed; node-1 lost node-2"
    assert run["recorder"].death() == "recorder was killed by SIGTERM"


def test_exit_codes_speak_where_nobody_said_anything() -> None:
    run = {"node-1": Process("node-1"), "node-2": Process("node-2")}
    run["node-2"].hear({"event": "exit", "code": 70}, NOW)
    assert first_cause(run) == "node-2 ended with exit code 70"
