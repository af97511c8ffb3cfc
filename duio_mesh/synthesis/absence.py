"""What every coupled observer's options say about messages that do not come."""

from __future__ import annotations

from typing import Literal

from duio_mesh.scenario.strict import Strict


class Absence(Strict):
    """Options of the methods that exchange their estimate once per step."""

    without: Literal["skip", "hold", "pair"] = "skip"
    """Under faults, without a neighbour's message: leave the edge out; take its last one; pair late ones by step."""
