"""What the user wrote: a topology file -> a typed, checked Scenario; every error says file:line:column."""

from duio_mesh.scenario.dump import scenario_yaml
from duio_mesh.scenario.load import load_scenario

__all__ = ["load_scenario", "scenario_yaml"]
