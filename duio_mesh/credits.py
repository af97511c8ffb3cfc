"""How far every node is: what keeps the plant, or a gateway, at most a window of steps ahead of the slowest."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from queue import Empty

from duio_mesh.errors import RunError
from duio_mesh.mesh import Mesh, Source
from duio_mesh.mesh.lockstep import soon
from duio_mesh.mesh.rejoin import ASK
from duio_mesh.process import Report
from duio_mesh.spec import PATIENCE, PlantSpec


class Credits:
    """How many steps each node has finished, and who is not there."""

    def __init__(self, mesh: Mesh, sources: Mapping[int, Source], spec: PlantSpec, report: Report) -> None:
        self._mesh, self._sources, self._spec, self._report = mesh, sources, spec, report
        self._ids = {source: i for i, source in sources.items()}
        self._done = dict.fromkeys(sources, 0)
        self._asking: dict[int, int] = {}  # nodes that want to come back -> processes of each before
        self.away: set[int] = set()
        self._deadline = spec.deadline * (1 if spec.on_loss == "stop" else PATIENCE)

    def collect(self) -> None:
        """Take what has arrived, without waiting."""
        while self._mesh.pending():
            self._take(0.0)

    def wait(self, steps: int, before: int | None = None) -> None:
        """Wait until every node that is there has finished ``steps`` steps.

        ``before``: the step that is to be sent next. Then a node that is being replaced is waited for as well, until it
        asks to come back: the others are never more than a window ahead of where it was lost.
        Raises RunError naming the nodes that do not move before the deadline, or that are lost.
        """
        self._until(lambda: self._late(steps) + self._replaced(steps, before), steps)

    def admit(self, k: int) -> dict[int, int]:
        """Who comes back at step k -> processes of it before; those that are meant to are waited for."""
        absent = self._spec.absent
        expected = [i for i, spans in absent.items() if any(after == k for _, after in spans)]
        self._until(lambda: [i for i in expected if i not in self._asking], k)
        early = {i for i in self._asking if self._planned(i, k)}
        back = {i: before for i, before in self._asking.items() if i not in early}
        self._asking = {i: before for i, before in self._asking.items() if i in early}
        self._done |= dict.fromkeys(back, k)
        self.away -= back.keys()
        return back

    def _late(self, steps: int) -> list[int]:
        """The nodes to wait for."""
        there = [i for i in self._done if i not in self.away]
        if there:
            return [i for i in there if self._done[i] < steps]
        if self._spec.on_loss != "restart":
            raise RunError(f"the plant has lost every node before step {steps}")
        return [] if self._asking else list(self._done)

    def _replaced(self, steps: int, before: int | None) -> list[int]:
        """Nodes that are lost, not on purpose at this time, and whose next process has not asked yet."""
        if before is None or self._spec.on_loss != "restart":
            return []
        unplanned = [i for i in sorted(self.away) if i not in self._asking and not self._planned(i, before)]
        return [i for i in unplanned if self._done[i] < steps]

    def _planned(self, i: int, k: int) -> bool:
        """Whether node i is not meant to be there in step k."""
        return any(first <= k < after for first, after in self._spec.absent.get(i, ()))

    def _until(self, missing: Callable[[], list[int]], steps: int) -> None:
        heard, said = time.monotonic(), False
        while late := missing():
            lost = [self._sources[i].who for i in late if self._sources[i].gone]
            if lost and not self._mesh.pending():
                raise RunError(f"the plant lost {', '.join(lost)} before step {steps}", lost)
            try:
                self._take(soon(self._spec.deadline))
                heard = time.monotonic()
                if said:
                    said = False
                    self._report("moving")
            except Empty:
                who = [self._sources[i].who for i in late]
                if time.monotonic() - heard > self._deadline:
                    words = ", ".join(f"node-{i} (last heard of at step {self._done[i]})" for i in late)
                    raise RunError(
                        f"the plant waited {self._deadline:g} s for {words} to finish step {steps - 1}"
                    ) from None
                if not said:
                    said = True
                    self._report("waiting", on=who, link="", k=steps - 1, r=0, waited=time.monotonic() - heard)
        if said:
            self._report("moving")

    def listen(self, seconds: float) -> None:
        """Take the next word of a node, if there is one within so many seconds."""
        with suppress(Empty):
            self._take(seconds)

    def behind(self, steps: int) -> list[str]:
        """The nodes that have not finished so many steps, and where they are."""
        return [f"node-{i} (at step {self._done[i]})" for i in self._late(steps)]

    def _take(self, timeout: float) -> None:
        got = self._mesh.get(timeout)
        if got is None:  # somebody has gone
            if self._spec.on_loss != "stop":
                for i, source in self._sources.items():
                    if source.gone and self._done[i] < self._spec.steps:
                        source.gone = False
                        self.away.add(i)
                        self._asking.pop(i, None)
            return
        i, frame = self._ids[got[0]], got[1]
        if frame.r == ASK:
            self._asking[i] = got[0].before = frame.k
            got[0].gone = False
            self.away.add(i)
        else:
            self._done[i] = max(self._done[i], min(frame.k, self._spec.steps))
