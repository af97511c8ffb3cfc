"""The base of every piece of a topology file: unknown keys, NaN, infinities and silent conversions are errors."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """A mapping in a topology file. A method's ``Options`` (synthesis/<method>.py) derives from this too."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
