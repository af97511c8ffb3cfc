"""Which sample belongs to which step, whatever the order of arrival."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.sensors import steps as room
from duio_mesh.sensors.messages import Refused, Sample
from duio_mesh.sensors.steps import Steps

KEYS = {"a": 1, "b": 1, "c": 1}


def sample(value: float, number: int | None = None) -> Sample:
    return Sample(np.array([float(value)]), number)


def taken(steps: Steps, now: float = 0.0) -> list[tuple[float, ...]]:
    """All steps that are complete."""
    found = []
    while (step := steps.next(now)) is not None:
        found.append(tuple(float(step[key][0]) for key in KEYS))
    return found


@settings(deadline=None, derandomize=True, max_examples=100)
@given(data=st.data())
def test_common_numbers_give_the_same_steps_in_any_order(data: st.DataObject) -> None:
    """Each sensor's samples 0..9 from its own first one on, shuffled among the sensors, with copies."""
    firsts = {key: data.draw(st.integers(0, 4)) for key in KEYS}
    sent = [(key, number) for key, first in firsts.items() for number in range(first, 10)]
    order = data.draw(st.permutations(sent + data.draw(st.lists(st.sampled_from(sent), max_size=5))))
    steps, found, refused = Steps(KEYS, common=True), [], set()
    for key, number in [*firsts.items(), *order]:  # nobody could know otherwise which sample is a sensor's first
        try:
            steps.add(key, sample(1000 * ord(key) + number, number))
        except Refused as e:
            refused.add(e.cause)
        found += taken(steps)
    assert refused <= {"seen before"}
    first = max(firsts.values())
    assert found == [tuple(1000.0 * ord(key) + number for key in KEYS) for number in range(first, 10)]


def test_who_does_not_count_is_taken_in_order_from_what_was_newest() -> None:
    steps = Steps(KEYS, common=True)
    for value in (1, 2, 3):
        steps.add("a", sample(value))
    steps.add("b", sample(10))
    assert taken(steps) == []
    assert steps.missing() == ["c"]
    steps.add("c", sample(100))
    assert taken(steps) == [(3, 10, 100)]
    for key, value in (("c", 101), ("c", 102), ("a", 4), ("b", 11), ("b", 12), ("a", 5)):
        steps.add(key, sample(value))
    assert taken(steps) == [(4, 11, 101), (5, 12, 102)]


def test_publishers_that_count_for_themselves_start_at_their_newest_and_show_their_gaps() -> None:
    steps = Steps(KEYS, common=False)
    for key, number in (("a", 7), ("a", 8), ("b", 1), ("c", 40)):
        steps.add(key, sample(number, number))
    assert taken(steps) == [(8, 1, 40)]
    for key, number in (("a", 9), ("b", 3), ("c", 41)):  # b lost its number 2
        steps.add(key, sample(number, number))
    assert taken(steps) == []
    assert steps.missing() == ["b"]
    assert steps.doing("b") == "its sample 2 is missing; the last was number 3"


def test_late_sensors_keep_their_last_value_only_after_the_time_for_it() -> None:
    steps = Steps(KEYS, common=True, hold=2.0)
    for key in KEYS:
        steps.add(key, sample(ord(key), 0))
    assert len(taken(steps)) == 1
    assert taken(steps, 100.0) == [], "nobody has spoken: time alone is no step"
    steps.add("a", sample(1, 1))
    steps.add("b", sample(2, 1))
    assert taken(steps, 100.5) == []
    assert taken(steps, 102.4) == []
    assert taken(steps, 102.5) == [(1, 2, ord("c"))]
    assert steps.held == {"c": 1}
    with pytest.raises(Refused, match="seen before"):
        steps.add("c", sample(3, 1))  # it comes after all
    for key in KEYS:
        steps.add(key, sample(5, 2))
    assert taken(steps, 103.0) == [(5, 5, 5)]
    with pytest.raises(Refused, match="no number"):
        steps.add("c", sample(3))


def test_who_waits_long_for_the_others_begins_with_what_is_new(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "BACKLOG", 4)
    steps = Steps(KEYS, common=True)
    for number in range(100):
        steps.add("a", sample(number, number))
    steps.add("b", sample(0, 98))
    steps.add("c", sample(0, 97))
    steps.add("c", sample(0, 98))
    assert taken(steps) == [(98, 0, 0)]


def test_what_is_refused_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(room, "BACKLOG", 4)
    steps = Steps(KEYS, common=True, hold=inf)
    for key in KEYS:
        steps.add(key, sample(0, 5))
    assert taken(steps) == [(0, 0, 0)]
    for number, cause in ((5, "seen before"), (4, "seen before"), (10, "too far ahead"), (2**62, "too far ahead")):
        with pytest.raises(Refused, match=cause):
            steps.add("a", sample(9, number))
    with pytest.raises(Refused, match="others without"):
        steps.add("a", sample(9))
    for key in KEYS:
        steps.add(key, sample(1, 6))
    assert taken(steps) == [(1, 1, 1)]
