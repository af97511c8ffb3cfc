"""What the certificate says of lost edges and nodes (``synthesis/contingency.py``), sorted and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

SLOW = 0.1  # of an error left by a step that starts afresh: the estimate is not worth its name
FEW = 8  # nodes that a sentence names


class Rest(Enum):
    """What those who are left still do."""

    GOOD = "reconstructs"
    SLOW = "too slowly"
    BAD = "does not"


VERBS = {
    Rest.GOOD: "still reconstruct",
    Rest.SLOW: "still reconstruct, but too slowly to be of use",
    Rest.BAD: "no longer reconstruct",
}


def rest(case: Mapping[str, Any]) -> Rest:
    """What is left after a loss: a case as ``contingency.Cases`` gives it."""
    if case["failing"]:
        return Rest.BAD
    return Rest.SLOW if (case.get("left") or 0.0) > SLOW else Rest.GOOD


def badness(case: Mapping[str, Any]) -> tuple[bool, float]:
    """Sorts cases: the larger, the worse."""
    return bool(case["failing"]), math.inf if case["radius"] is None else float(case["radius"])


def node_loss_in_words(cases: Mapping[Any, Mapping[str, Any]], policy: str) -> str:
    """``node_loss`` of a certificate as a sentence; ``policy`` is ``run.on_node_loss``."""
    if not cases:
        return ""
    found = {kind: [str(i) for i, case in cases.items() if rest(case) is kind] for kind in Rest}
    said = [f"without {_named(ids)} the others {VERBS[kind]}" for kind, ids in found.items() if ids]
    i, worst = max(cases.items(), key=lambda item: badness(item[1]))
    radius = "" if worst["radius"] is None else f" Largest spectral radius: {worst['radius']:.6g}, without node {i}."
    return f"If a node is lost (`{policy}`): {'; '.join(said)}.{radius}"


def _named(ids: list[str]) -> str:
    if len(ids) > FEW:
        return f"any one of {len(ids)} nodes"
    return f"node {ids[0]}" if len(ids) == 1 else f"node {', '.join(ids[:-1])} or {ids[-1]}"
