"""The key expressions of one run (docs/design.md, the wire)."""

from __future__ import annotations

from typing import NamedTuple


class Keys(NamedTuple):
    """All key expressions of a run live under ``duio/<run>/``; processes are called plant, recorder and node-<id>."""

    run: str

    def plant(self, i: int) -> str:
        """Plant to node i: samples."""
        return f"duio/{self.run}/plant/{i}"

    def edge(self, i: int, j: int) -> str:
        """Node i to its neighbour j: the vectors of the observers."""
        return f"duio/{self.run}/edge/{i}/{j}"

    def credit(self, i: int) -> str:
        """Node i to the plant: steps done."""
        return f"duio/{self.run}/credit/{i}"

    def ready(self, source: int | str, target: int | str) -> str:
        """Declared by the target after its data subscriber: the source may start once this matches."""
        return f"duio/{self.run}/ready/{source}/{target}"

    def trace(self, i: int) -> str:
        """Node i to the recorder: batches of estimates."""
        return f"duio/{self.run}/trace/{i}"

    def truth(self) -> str:
        """Plant to the recorder: batches of true states."""
        return f"duio/{self.run}/truth"

    def alive(self, who: str, before: int = 0) -> str:
        """Liveliness token of a process, which replaces ``before`` others; ``**`` for all."""
        return f"duio/{self.run}/alive/{who}" + (f"/{before}" if before else "")
