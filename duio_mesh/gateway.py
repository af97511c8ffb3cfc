"""The life of the gateway process, which takes the plant's place when the measurements come from outside.

Towards the nodes it is the plant: the same keys, frames, start barrier and credits. The outside world reaches a second
Zenoh session, which has no link to the mesh; every message is checked before it counts (docs/sensors.md).
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.credits import Credits
from duio_mesh.errors import RunError
from duio_mesh.journal import Journal
from duio_mesh.mesh import Heard, Mesh, OutsideWorld
from duio_mesh.mesh.rejoin import admit
from duio_mesh.plant import RECORDER
from duio_mesh.process import Report, main
from duio_mesh.sensors.messages import ROS, Refused, read
from duio_mesh.sensors.steps import Steps
from duio_mesh.spec import Outside, PlantSpec

BEAT = 0.5  # seconds between signs of life while nothing comes
LOOK = 0.02  # seconds between looks at the clock where late sensors are given up
DRAIN = 2  # messages of each sensor that are taken before the next look; the others wait where they cost nothing
FEW = 6  # keys that a message names
NO_SAMPLE = np.zeros(0)


def run(spec: PlantSpec, report: Report) -> None:
    """Pass on ``spec.steps`` steps, or fewer when a publisher says that it is over.

    Raises RunError naming the key of a sensor that is late, or the node that is lost or does not keep up.
    """
    if (outside := spec.outside) is None:
        raise RunError("this plant is simulated: start duio_mesh.plant instead of duio_mesh.gateway")
    with OutsideWorld(outside, report.warn) as world, Mesh(spec.wire, "plant", report.warn) as mesh:
        keys, ids = mesh.keys, sorted(outside.feeds)
        nodes = {i: mesh.hear(keys.credit(i), f"{i} -> plant", f"node-{i}", ready=(i, "plant")) for i in ids}
        samples = {i: mesh.speak([(keys.plant(i), f"plant -> {i}", ("plant", i))]) for i in ids}
        mesh.watch()
        mesh.meet()
        # nobody knows the truth; the recorder's barrier hangs on its key
        _truth = mesh.speak([(keys.truth(), "plant -> recorder", ("plant", "recorder"))], drop=True)
        if spec.recorded and mesh.unanswered(RECORDER):
            report.warn(f"the recorder was not there after {RECORDER:g} s; starting without it")
        report("ready")
        credits, inlet = Credits(mesh, nodes, spec, report), Inlet(spec, outside, world, report)
        report.last = lambda: {"rejected": mesh.rejections() | inlet.rejections()}
        size = sum(outside.widths().values())
        done, rows = 0, dict[int, Array]()
        begin, cpu = time.monotonic(), time.process_time()
        with Journal(spec.output, size, mesh.speak([])) as journal:
            while done < spec.steps and (step := inlet.next(credits)) is not None:
                if not done:
                    begin = time.monotonic()  # the first may take its time
                credits.collect()
                credits.wait(done + 1 - spec.window)
                if back := credits.admit(done):
                    admit(samples, done, back, credits.away, rows)
                rows = {i: np.concatenate([step[key] for key in outside.feeds[i]]) for i in ids}
                for i, outlet in samples.items():
                    outlet.send(done, 0, rows[i])
                journal.add(tuple(rows.values()))
                done += 1
            if done < spec.steps:
                for outlet in samples.values():
                    outlet.send(done, 0, NO_SAMPLE)
            journal.flush()
            credits.wait(done)
        report(
            "done",
            steps=done,
            seconds=time.monotonic() - begin,
            cpu_seconds=time.process_time() - cpu,
            frames=sum(outlet.frames for outlet in samples.values()),
            rejected=mesh.rejections() | inlet.rejections(),
            held=dict(inlet.steps.held),
        )


class Inlet:
    """From the outside world's messages to complete steps."""

    def __init__(self, spec: PlantSpec, outside: Outside, world: OutsideWorld, report: Report) -> None:
        self._spec, self._outside, self._world, self._report = spec, outside, world, report
        self.steps = Steps(outside.sizes, common=outside.encoding not in ROS, hold=outside.hold)
        self._refused: Counter[tuple[str, str]] = Counter()  # (key, cause)
        self._over = False
        self._told: list[str] = []

    def next(self, credits: Credits) -> dict[str, Array] | None:
        """The next complete step by key, None when a publisher has said that it is over.

        Raises RunError when no step gets complete in time, naming the keys on which nothing came.
        """
        begin, beat = time.monotonic(), 0.0
        limit = self._spec.deadline if self.steps.k else self._outside.start_within
        while (step := self.steps.next(now := time.monotonic(), over=self._over)) is None:
            if self._over:
                self._end()
                return None
            if now - begin > limit:
                raise RunError(self._why(limit))
            if now >= beat:
                beat = now + BEAT
                self._report.beat()
                credits.collect()  # so that nothing piles up while the sensors take their time
            self._tell()
            self._hear(LOOK if self._outside.hold < limit else max(0.0, min(beat, begin + limit) - now))
        self._tell()
        return step

    def _hear(self, timeout: float) -> None:
        """Take the next messages, waiting for the first: several, because a look at the step costs all its keys."""
        if heard := self._world.get(timeout):
            self._take(heard)
            for more in self._world.at_once(DRAIN * len(self._outside.sizes)):
                self._take(more)

    def _take(self, heard: Heard) -> None:
        """One message: a sample, or nothing but a count."""
        if not heard.key:
            self._over = True
            return
        try:
            if heard.stray:
                raise Refused("no node of this run has this key")
            if heard.payload is None:
                raise Refused("deleted instead of published")
            size = self._outside.sizes[heard.key]
            self.steps.add(heard.key, read(self._outside.encoding, heard.payload, heard.attachment, size))
        except Refused as e:
            known = (heard.key, e.cause) if not heard.stray else ("other keys", e.cause)
            self._refused[known] += 1
            if self._refused[known] == 1:
                self._report.warn(f"refused a sample on {heard.key}: {e.cause}")

    def _tell(self) -> None:
        """Before the first step: for whom we wait, whenever that changes."""
        waiting = [] if self.steps.started else self.steps.missing()
        if waiting != self._told:
            self._told = waiting
            self._report("sensors", text=f"waiting for {_some(waiting)}" if waiting else "")

    def _end(self) -> None:
        """A publisher has said that it is over. Raises RunError when that was before the first step."""
        if not self.steps.k:
            who = _some([f"{key} ({self._doing(key)})" for key in self.steps.missing()])
            raise RunError(f"the gateway heard that it is over before the first step was complete: {who}")

    def _why(self, limit: float) -> str:
        late = self.steps.missing()
        what = f"step {self.steps.k}" if self.steps.k else "the first sample"
        return f"the gateway waited {limit:g} s for {what} of {_some([f'{key} ({self._doing(key)})' for key in late])}"

    def _doing(self, key: str) -> str:
        refused = [f"{n} refused: {cause}" for (where, cause), n in self._refused.items() if where == key]
        return "; ".join([self.steps.doing(key), *refused])

    def rejections(self) -> dict[str, int]:
        """How many samples were refused, by key and cause."""
        lost = {"the queue of the gateway was full": self._world.dropped} if self._world.dropped else {}
        return {f"{key}: {cause}": n for (key, cause), n in self._refused.items()} | lost


def _some(words: list[str]) -> str:
    more = f" and {len(words) - FEW} more" if len(words) > FEW else ""
    return ", ".join(words[:FEW]) + more


if __name__ == "__main__":
    main(PlantSpec, run)
