"""What the launcher does about a node whose process was lost: nothing, go on without it, or start another one."""

from __future__ import annotations

from collections.abc import Callable

from duio_mesh.diagnosis import Process
from duio_mesh.errors import RunError
from duio_mesh.supervisor import Supervisor

READY = 1.0  # seconds in which those that are just about to say that they are ready may do so
TRIES = 3  # processes in a row that may be lost before one of them is back in step


class Recovery:
    """Decides about each lost process, after its death is certain: its exit status has been collected."""

    def __init__(self, supervisor: Supervisor, policy: str, replace: Callable[[str, int], None]) -> None:
        """``policy``: degrade or restart. ``replace(who, before)`` starts another process; so many were before it."""
        self._supervisor, self._policy, self._replace = supervisor, policy, replace
        self._failed: dict[str, int] = {}  # processes that were lost since the last one that was in step

    def __call__(self, lost: Process) -> bool:
        """Whether the run goes on. Raises RunError when a node does not come back."""
        if not lost.who.startswith("node-"):
            return False
        supervisor, who = self._supervisor, lost.who
        if self._policy == "degrade" and not supervisor.all_ready(READY):
            # the others would look for it until the start's time is over
            lost.warnings.append("it was lost before everybody was there, and a run begins with everybody")
            return False
        supervisor.remember("death", who=who, text=lost.death())
        if self._policy == "degrade" or supervisor.source_done():
            lost.there = False
            lost.warnings.append(f"{lost.death()}; the others went on without it")
            return True
        self._failed[who] = self._failed.get(who, 0) + 1 if lost.before and not lost.back else 0
        if self._failed[who] >= TRIES:
            raise RunError(f"{who} did not come back: {TRIES} processes in a row were lost before they were in step")
        lost.warnings.append(f"{lost.death()}; another process took its place")
        self._replace(who, lost.before + 1)
        return True
