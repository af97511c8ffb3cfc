"""Signals as written -> signals as ``duio_mesh.dynamics`` evaluates them: every parameter filled in, one spelling."""

from __future__ import annotations

import math

from duio_mesh.scenario import schema
from duio_mesh.scenario.model import Signal

ZERO: Signal = ()


def normalised(written: schema.Signal) -> Signal:
    """A sum of ``{kind: parameters}`` terms; the constant 0 is the empty sum."""
    if isinstance(written, list):
        return tuple(term for part in written for term in normalised(part))
    if isinstance(written, float | int):
        return ({"constant": {"value": float(written)}},) if written else ZERO
    kind = next(name for name in written.forms if getattr(written, name) is not None)
    return ({kind: _parameters(getattr(written, kind))},)


def white(std: float) -> Signal:
    """Zero-mean white noise."""
    return ({"normal": {"mean": 0.0, "std": std}},)


def _parameters(
    term: schema.Constant | schema.Wave | schema.Step | schema.Gaussian,
) -> dict[str, float]:
    if isinstance(term, schema.Wave):
        period = 2 * math.pi / term.rate if term.rate is not None else term.period
        assert period is not None  # noqa: S101  (Wave has one of the two)
        return {"amplitude": term.amplitude, "period": period, "phase": term.phase}
    if isinstance(term, schema.Gaussian):
        std = math.sqrt(term.variance) if term.variance is not None else term.std
        assert std is not None  # noqa: S101  (Gaussian has one of the two)
        return {"mean": term.mean, "std": std}
    return {name: float(value) for name, value in term.model_dump().items()}
