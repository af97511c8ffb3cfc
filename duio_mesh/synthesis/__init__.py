"""Offline: the global design. Sees the whole scenario, hands each node only its own. One file per method."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from duio_mesh.errors import DesignError
from duio_mesh.observers.base import can_batch
from duio_mesh.scenario.model import Scenario
from duio_mesh.synthesis.design import Design
from duio_mesh.synthesis.recovery import with_recovery
from duio_mesh.synthesis.timing import on_the_clock

__all__ = ["Design", "options_of", "synthesise"]


def options_of(method: str) -> type[Any]:
    """The pydantic model of what may stand under ``observer:`` for this method."""
    model: type[Any] = importlib.import_module(f"duio_mesh.synthesis.{method}").Options
    return model


def synthesise(scenario: Scenario, progress: Callable[[str], None] = lambda _: None) -> Design:
    """Check the theory's conditions and design every gain.

    ``progress`` is called with a short sentence before each long piece of work.
    Raises DesignError when a condition fails or no gains exist; the message says which, where and by how much.
    """
    observer = importlib.import_module(f"duio_mesh.observers.{scenario.method}").Observer
    if (batch := scenario.run.batch) > 1 and not can_batch(observer):
        raise DesignError(
            f"run.batch: {scenario.method} needs each step's exchange before the next step, so it cannot take {batch} "
            "steps at once; remove run.batch, or use a method without memory between its fusions (admm)"
        )
    design: Design = importlib.import_module(f"duio_mesh.synthesis.{scenario.method}").design(scenario, progress)
    if scenario.run.on_node_loss != "stop":
        design = with_recovery(design, progress)
    return on_the_clock(design)
