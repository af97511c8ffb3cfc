"""What may stand under ``observer:`` for ``method: admm``."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, PositiveFloat, model_validator
from pydantic_core import PydanticCustomError

from duio_mesh.scenario.strict import Strict

_USED = {
    "admm": {"normalised", "gamma", "nu", "alpha_factor"},
    "finite_time": set[str](),
    "relaxed": {"c", "rounds"},
}
"""The options that belong to one fusion only."""

Rounds = Annotated[int, Field(ge=1, le=1_000_000)]


class Options(Strict):
    """The keys under ``observer:``."""

    fusion: Literal["admm", "finite_time", "relaxed"] = "admm"
    """admm: (15). finite_time: the exact solution in as few rounds as the graph allows. relaxed: for lossy edges."""
    normalised: bool = True
    """admm: the step (PS), which makes the problem's curvature 1."""
    gamma: PositiveFloat = 0.5
    """admm: penalty of (15)."""
    nu: Rounds = 60
    """admm: iterations per step; nu - 1 messages per edge and direction."""
    alpha_factor: PositiveFloat = 1.0
    """admm: times the step size (16). Above 1 no theorem holds; the iteration's spectral radius is checked."""
    c: PositiveFloat = 0.01
    """relaxed: pull towards the neighbours. Small is fast; with noise only a large one is near the best estimate."""
    rounds: Rounds = 80
    """relaxed: exchanges per step."""
    setup: Literal["global", "distributed"] = "global"
    """Who computes H = sum T_i'T_i: the launcher, or the nodes by exchanging n (n+1)/2 numbers in step 0."""
    initial: Literal["zero", "projection"] = "zero"
    """s_i(0): zero, or P_i times the plant's x0 (its mean when it is drawn), if that is known when the nodes start."""
    stable_radius: Annotated[float, Field(gt=0, le=1)] = 0.99
    """A node follows only what decays faster than stable_radius^k; larger follows more, and forgets s_i(0) slower."""
    poles: tuple[Annotated[float, Field(gt=-1, lt=1)], ...] | None = None
    """Where a node puts the eigenvalues of its local estimate that are free; by default a Kalman-type gain decides."""

    without: Literal["auto", "hold", "predict"] = "auto"
    """Under faults, in a step that misses messages: hold the newest, or predict from the step before; both flag it."""

    watch_step: Annotated[int, Field(ge=0)] | None = None
    """A step whose rounds are recorded one by one: every node's residual and disagreement; by default none is."""

    @model_validator(mode="after")
    def _no_idle_option(self) -> Options:
        for fusion, names in _USED.items():
            for name in sorted(names & self.model_fields_set):
                if fusion != self.fusion:
                    raise _misfit(f"has no meaning with fusion: {self.fusion}, only with fusion: {fusion}", name)
        if self.setup == "distributed" and not self.needs_H:
            raise _misfit("there is nothing to set up: normalised: false does not use H", "setup")
        return self

    @property
    def needs_H(self) -> bool:
        """Whether the nodes need H^-1."""
        return self.fusion != "admm" or self.normalised


def _misfit(message: str, at: str) -> PydanticCustomError:
    context: dict[str, Any] = {"message": message, "at": at}
    return PydanticCustomError("misfit", "{message}", context)
