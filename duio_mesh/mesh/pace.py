"""The plant's wall clock: sample k at begin + k ticks, without drift, and never a crowd of samples at once."""

from __future__ import annotations

import time
from typing import Any, Protocol

from duio_mesh.spec import PlantSpec

LATE = 0.5  # of a tick


class Credits(Protocol):
    """How far the nodes are."""

    def wait(self, steps: int) -> None:
        """Until every node has finished so many steps."""
        ...

    def listen(self, seconds: float) -> None:
        """Take the next word of a node, if there is one within so many seconds."""
        ...

    def behind(self, steps: int) -> list[str]:
        """The nodes that have not finished so many steps, in words."""
        ...


class Pace:
    """Tells the plant when to go on; in lockstep at once.

    Step 0 is not timed: nodes set themselves up in it, and the clock begins when all have finished it. A plant that is
    late (it was stopped, or had to wait for a node that was a whole window behind) makes up for it, but leaves the
    nodes the time to hear each other between two samples, the part of a tick that they may wait.
    """

    def __init__(self, spec: PlantSpec, credits: Credits) -> None:
        self._tick, self._wait, self._window, self._credits = spec.tick, spec.wait, spec.window, credits
        self._zero = self._sent = 0.0  # when sample 0 would have been due, and when the last one was let go
        self.said: dict[str, Any] = {"late_ticks": 0, "worst_lateness": 0.0, "behind": []} if spec.tick else {}
        """Ticks that began more than half a tick late, the worst in seconds, and who was far behind then."""

    def until(self, k: int) -> None:
        """Wait until sample k is due, on the queue of the nodes' words."""
        if not self._tick or not k:
            return
        if k == 1:
            self._credits.wait(1)
            self._zero = time.monotonic() - self._tick
        due = self._zero + k * self._tick
        far = k - self._window // 2
        behind = self._credits.behind(far) if far > 0 and time.monotonic() > due else []  # now, before they catch up
        start = max(due, self._sent + self._wait)
        while (left := start - time.monotonic()) > 0:
            self._credits.listen(left)
        self._sent = time.monotonic()
        late = self._sent - due
        self.said["late_ticks"] += late > LATE * self._tick
        if late > self.said["worst_lateness"]:
            self.said.update(worst_lateness=late, behind=behind)
