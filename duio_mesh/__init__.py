"""Run distributed unknown-input observers as real processes that talk over Zenoh along the edges of a graph.

    scenario = load_scenario("topologies/ring.yaml", **{"run.steps": 500})
    design = synthesise(scenario)        # per-node matrices and a certificate
    trace = simulate(design)             # the oracle, in this process
    result = run(design, out="runs/x")   # the mesh: one process per sensor

Names are loaded when they are first used: a node process imports this package too, and must stay small.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from duio_mesh.api import load_scenario, run, simulate, synthesise
    from duio_mesh.errors import DesignError, DuioError, RunError, ScenarioError
    from duio_mesh.launcher import RunResult
    from duio_mesh.scenario.model import Scenario
    from duio_mesh.simulation import Trace
    from duio_mesh.synthesis.design import Design

__version__ = "0.1.0"
__all__ = [
    "Design",
    "DesignError",
    "DuioError",
    "RunError",
    "RunResult",
    "Scenario",
    "ScenarioError",
    "Trace",
    "load_scenario",
    "run",
    "simulate",
    "synthesise",
]

_HOMES = {
    "Design": "synthesis.design",
    "DesignError": "errors",
    "DuioError": "errors",
    "RunError": "errors",
    "RunResult": "launcher",
    "Scenario": "scenario.model",
    "ScenarioError": "errors",
    "Trace": "simulation",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'duio_mesh' has no attribute {name!r}")
    return getattr(importlib.import_module(f"duio_mesh.{_HOMES.get(name, 'api')}"), name)
