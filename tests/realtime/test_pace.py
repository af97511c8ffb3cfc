"""The plant's clock, with a clock of the test's own in place of the wall's."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from duio_mesh.mesh import pace as room
from duio_mesh.mesh.pace import Pace
from duio_mesh.spec import PlantSpec

TICK, WAIT, WINDOW = 0.1, 0.05, 20
SPEC = PlantSpec(
    time="discrete", step=1.0, matrices={}, x0={}, feedback={}, control=(), disturbance=(), sensors=(), seed=0,
    steps=1000, window=WINDOW, block=1, deadline=5.0, tick=TICK, wait=WAIT,
)  # fmt: skip


class World:
    """Time that passes only while somebody waits, and nodes whose words wake the plant early."""

    def __init__(self, setup: float = 3.0, wake: float = 0.013) -> None:
        self.now, self._setup, self._wake = 1000.0, setup, wake
        self.slow: list[str] = []

    def wait(self, steps: int) -> None:
        assert steps == 1
        self.now += self._setup  # step 0 takes its time

    def listen(self, seconds: float) -> None:
        assert seconds > 0
        self.now += min(seconds, self._wake)

    def behind(self, steps: int) -> list[str]:
        return self.slow


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    made = World()
    monkeypatch.setattr(room, "time", SimpleNamespace(monotonic=lambda: made.now))
    return made


def test_samples_leave_on_the_clock_and_it_does_not_drift(world: World) -> None:
    pace, left = Pace(SPEC, world), []
    pace.until(0)
    assert world.now == 1000.0
    for k in range(1, 501):
        pace.until(k)
        left.append(world.now)
        world.now += 0.03 + 0.01 * (k % 3)  # work of the plant's own
    assert left[0] == pytest.approx(1003.0)  # when step 0 is done
    assert left == pytest.approx([1003.0 + TICK * k for k in range(500)])
    assert pace.said["late_ticks"] == 0
    assert pace.said["worst_lateness"] < 1e-9


def test_a_plant_that_was_held_up_makes_up_for_it_without_a_crowd(world: World) -> None:
    pace = Pace(SPEC, world)
    left = {}
    for k in range(1, 200):
        if k == 50:
            world.now += 2.0  # 20 ticks
            world.slow = ["node-3 (at step 12)"]
        pace.until(k)
        left[k] = world.now
    apart = [left[k + 1] - left[k] for k in range(1, 199)]
    assert min(apart) == pytest.approx(WAIT)
    late = {k: left[k] - (left[1] + TICK * (k - 1)) for k in left}
    assert late[49] == pytest.approx(0)
    assert late[199] == pytest.approx(0)
    assert pace.said["late_ticks"] == sum(seconds > TICK / 2 for seconds in late.values()) > 20
    assert pace.said["worst_lateness"] == pytest.approx(max(late.values()))
    assert pace.said["behind"] == ["node-3 (at step 12)"]


def test_in_lockstep_there_is_no_clock(world: World) -> None:
    pace = Pace(replace(SPEC, tick=0.0, wait=0.0), world)
    for k in range(100):
        pace.until(k)
    assert (world.now, pace.said) == (1000.0, {})
