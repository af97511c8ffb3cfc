"""What processes of other hosts said, from their collected logs: stands where a run on one host has its supervisor."""

from __future__ import annotations

import json
from pathlib import Path

from duio_mesh.account import Account
from duio_mesh.diagnosis import Process


class Logs(Account):
    """Knows processes by their logs."""

    def read(self, who: str, log: Path) -> None:
        """Take in a process' log: JSON lines, as it wrote them to its log or to its standard output.

        Other lines (a container's log has its standard error, too) are passed over, and a last one that was cut short
        when its host went down. Raises ValueError for JSON that is no event.
        """
        self.processes[who] = Process(who)
        for number, line in enumerate(log.read_text(encoding="utf-8").splitlines(keepends=True), 1):
            if not line.startswith("{") or not line.endswith("\n"):
                continue
            try:
                event = json.loads(line)
                self.hear({**event, "who": who})
            except (ValueError, KeyError, TypeError) as e:
                raise ValueError(f"{log}:{number} is not an event of a process: {e}") from None
