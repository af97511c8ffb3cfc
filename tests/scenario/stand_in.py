"""A stand-in for a method's options, so that the tests of the file format need no synthesis."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from duio_mesh.scenario import load_scenario
from duio_mesh.scenario.model import Scenario
from duio_mesh.scenario.strict import Strict


class Poles(Strict):
    """A branch of a union that is a mapping."""

    poles: tuple[float, float]


class Options(Strict):
    """One plain choice, one union."""

    decomposition: Literal["detectability", "observability"] = "detectability"
    local_gain: Literal["hinf", "h2"] | Poles = "hinf"
    consensus: Literal["paper", "norm"] = "paper"


def load(path: Path, *overrides: str) -> Scenario:
    """The scenario, with the stand-in options whatever the method."""
    return load_scenario(path, overrides, options_of=lambda method: Options)
