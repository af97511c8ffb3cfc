"""The life of the plant process: the true state, its sensors' noise, and flow control.

It is always ahead of the nodes by at most a window of steps: each node says how far it is, and the slowest one counts.
The truth goes to the plant's own file and to the recorder, never to a node.
"""

from __future__ import annotations

import time
from contextlib import suppress
from queue import Empty

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.dynamics import Plant
from duio_mesh.errors import RunError
from duio_mesh.journal import Journal
from duio_mesh.mesh import Mesh, Source
from duio_mesh.mesh.pace import Pace
from duio_mesh.process import Report, main
from duio_mesh.spec import PlantSpec

RECORDER = 3.0  # seconds to wait for a recorder, so that short runs can be seen from their beginning


class Credits:
    """How many steps each node has finished."""

    def __init__(self, mesh: Mesh, sources: list[Source], spec: PlantSpec) -> None:
        self._mesh, self._spec = mesh, spec
        self._done = dict.fromkeys(sources, 0)

    def slowest(self) -> int:
        """Steps that every node has finished."""
        return min(self._done.values())

    def collect(self) -> None:
        """Take what has arrived, without waiting."""
        while self._mesh.pending():
            self._take()

    def wait(self, steps: int) -> None:
        """Wait until every node has finished ``steps`` steps.

        Raises RunError naming the nodes that do not move before the deadline, or that are lost.
        """
        while self.slowest() < steps:
            late = [s for s, done in self._done.items() if done < steps]
            lost = [s.who for s in late if s.gone]
            if lost and not self._mesh.pending():
                raise RunError(f"the plant lost {', '.join(lost)} before step {steps}")
            try:
                self._take()
            except Empty:
                who = ", ".join(f"{s.who} (at step {self._done[s]})" for s in late)
                raise RunError(
                    f"the plant waited {self._spec.deadline:g} s for {who} to finish step {steps - 1}"
                ) from None

    def listen(self, seconds: float) -> None:
        """Take the next word of a node, if there is one within so many seconds."""
        with suppress(Empty):
            self._take(seconds)

    def behind(self, steps: int) -> list[str]:
        """The nodes that have not finished so many steps, and where they are."""
        return [f"{s.who} (at step {done})" for s, done in self._done.items() if done < steps]

    def _take(self, seconds: float | None = None) -> None:
        if got := self._mesh.get(self._spec.deadline if seconds is None else seconds):
            source, frame = got
            self._done[source] = max(self._done[source], min(frame.k, self._spec.steps))


def run(spec: PlantSpec, report: Report) -> None:
    """Run the plant for ``spec.steps`` steps. Raises RunError when a node is lost or does not keep up."""
    plant = Plant(spec)
    with Mesh(spec.wire, "plant", report.warn) as mesh:
        keys, ids = mesh.keys, [s.id for s in spec.sensors]
        nodes = [mesh.hear(keys.credit(i), f"{i} -> plant", f"node-{i}") for i in ids]
        samples = {i: mesh.speak([(keys.plant(i), f"plant -> {i}", ("plant", i))]) for i in ids}
        mesh.watch()
        mesh.meet()
        truth = mesh.speak([(keys.truth(), "plant -> recorder", ("plant", "recorder"))], drop=not spec.kept)
        if spec.kept:
            mesh.meet()
        elif spec.recorded and mesh.unanswered(RECORDER):  # it then reads what it missed from the journals
            report.warn(f"the recorder was not there after {RECORDER:g} s; starting without it")
        for i in ids:  # not before everybody is there: from now on a sample comes within a node's deadline
            mesh.announce((i, "plant"))
        report("ready")
        credits, begin, cpu = Credits(mesh, nodes, spec), time.monotonic(), time.process_time()
        pace = Pace(spec, credits)
        with Journal(spec.output, plant.x.size, truth) as journal:
            for k in range(0, spec.steps, spec.block):
                block = range(k, min(k + spec.block, spec.steps))
                credits.collect()
                credits.wait(block.stop - spec.window)
                pace.until(k)
                rows: dict[int, list[Array]] = {i: [] for i in ids}
                for _ in block:
                    for i, data in plant.sample().items():
                        rows[i].append(data)
                    journal.add((plant.x,))
                    plant.advance()
                for i, outlet in samples.items():
                    outlet.send(k, 0, np.array(rows[i]))
            journal.flush()
            credits.wait(spec.steps)
        frames = sum(outlet.frames for outlet in samples.values())
        report(
            "done",
            steps=spec.steps,
            seconds=time.monotonic() - begin,
            cpu_seconds=time.process_time() - cpu,
            frames=frames,
            rejected=mesh.rejections(),
            timing=pace.said,
        )


if __name__ == "__main__":
    main(PlantSpec, run)
