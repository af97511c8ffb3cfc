"""The Python interface, re-exported by ``duio_mesh``: read, design, simulate, run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from duio_mesh import launcher, scenario, simulation, synthesis
from duio_mesh.launcher import RunResult
from duio_mesh.scenario.model import Scenario
from duio_mesh.simulation import Trace
from duio_mesh.synthesis.design import Design


def load_scenario(path: str | Path, **overrides: Any) -> Scenario:
    """Read and check a topology file; ``overrides`` are dotted paths into it, e.g. ``**{"run.steps": 500}``.

    Their values are what JSON can say, and numpy's arrays and numbers.
    Raises ScenarioError with one line per problem, each with file:line:column.
    """
    pairs = [f"{name}={json.dumps(value, ensure_ascii=False, default=_plain)}" for name, value in overrides.items()]
    return scenario.load_scenario(path, pairs, options_of=synthesis.options_of)


def _plain(value: object) -> object:
    """What JSON does not know by itself: numpy's arrays and numbers."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a topology file has no form for {type(value).__name__}")


def synthesise(scenario: Scenario) -> Design:
    """Check the theory's conditions and design every gain. Raises DesignError when that is impossible."""
    return synthesis.synthesise(scenario)


def simulate(design: Design) -> Trace:
    """Run plant and observers in this process: the oracle that the mesh must equal bit for bit."""
    return simulation.simulate(design)


def run(design: Design, out: str | Path | None = None, *, record: bool = True, live: bool = False) -> RunResult:
    """Run plant, nodes and recorder as processes over Zenoh. Raises RunError when one is lost or late."""
    return launcher.run(design, out, record=record, live=live)
