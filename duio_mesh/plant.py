"""The life of the plant process: the true state, its sensors' noise, and flow control.

It is always ahead of the nodes by at most a window of steps: each node says how far it is, and the slowest one counts.
The truth goes to the plant's own file and to the recorder, never to a node.
"""

from __future__ import annotations

import time
from math import isfinite

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.credits import Credits
from duio_mesh.dynamics import Plant
from duio_mesh.errors import RunError
from duio_mesh.journal import Journal
from duio_mesh.mesh import Mesh
from duio_mesh.mesh.pace import Pace
from duio_mesh.mesh.rejoin import admit
from duio_mesh.process import Report, main
from duio_mesh.spec import PlantSpec, blocks

RECORDER = 4.0  # seconds to wait for a recorder, so that short runs can be seen from their beginning


def run(spec: PlantSpec, report: Report) -> None:
    """Run the plant for ``spec.steps`` steps. Raises RunError when a node is lost or does not keep up."""
    plant = Plant(spec)
    with Mesh(spec.wire, "plant", report.warn) as mesh:
        report.last = lambda: {"rejected": mesh.rejections()}
        keys, ids = mesh.keys, [s.id for s in spec.sensors]
        nodes = {i: mesh.hear(keys.credit(i), f"{i} -> plant", f"node-{i}") for i in ids}
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
        credits, begin, cpu = Credits(mesh, nodes, spec, report), time.monotonic(), time.process_time()
        pace = Pace(spec, credits)
        rows, zeros = dict[int, list[Array]](), np.zeros_like(plant.x)
        returns = [after for spans in spec.absent.values() for _, after in spans]
        with Journal(spec.output, plant.x.size, truth) as journal:
            for block in blocks(0, spec.steps, spec.block, returns):
                credits.collect()
                credits.wait(block.stop - spec.window, block.start)
                if back := credits.admit(block.start):
                    admit(samples, block.start, back, credits.away, {i: data[-1] for i, data in rows.items()})
                pace.until(block.start)
                rows = {i: [] for i in ids}
                for _ in block:
                    for i, data in plant.sample().items():
                        rows[i].append(data)
                    journal.add((plant.x,))
                    plant.advance()
                    if not isfinite(zeros.dot(plant.x)):
                        raise RunError(f"the plant's state overflowed at step {plant.k}; is the plant unstable?")
                for i, outlet in samples.items():
                    outlet.send(block.start, 0, np.array(rows[i]))
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
