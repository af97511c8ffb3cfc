"""The plant of a topology: shapes, names, and what drives it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.scenario import model, schema
from duio_mesh.scenario.problems import Path, Problems, did_you_mean, listed
from duio_mesh.scenario.shapes import Size, has_length, matrix, vector, weight
from duio_mesh.scenario.signals import ZERO, normalised
from duio_mesh.scenario.validate import fields

PLANT: Path = ("plant",)


@dataclass(frozen=True)
class PlantParts:
    """What the nodes are checked against; a part that is wrong (and reported) is None."""

    plant: model.Plant | None
    states: Size | None
    inputs: tuple[str, ...] | None
    noise: schema.Noise | float | None  # as written, for every node without its own


def read_plant(written: Any, run: Mapping[str, Any], problems: Problems) -> PlantParts:
    """Check the plant against itself and the run's ``step``."""
    given = fields(schema.Plant, written, PLANT, problems)
    A = given.get("A")
    states = Size(len(A), "one per state") if A else None
    B, E = (_columns(given, name, states, problems) for name in "BE")
    inputs = _inputs(given, B, problems)
    m = Size(B.shape[1], "one per input") if B is not None else None
    parts: dict[str, Any] = {
        "time": given.get("time"),
        "step": _step(given, run, problems),
        "A": matrix(A, (*PLANT, "A"), problems, width=Size(len(A), "A is square") if A else None),
        "B": B,
        "E": E,
        "inputs": inputs,
        "x0": _initial(given, states, problems),
        "control": _control(given, states, m, inputs, problems),
        "disturbance": _disturbance(given, E, problems),
    }
    complete = all(part is not None for part in parts.values())
    return PlantParts(model.Plant(**parts) if complete else None, states, inputs, given.get("noise"))


def _columns(given: Mapping[str, Any], name: str, states: Size | None, problems: Problems) -> Array | None:
    """B or E; (n, 0) when it is not given."""
    if name not in given or states is None:
        return None
    if given[name] is None:
        return np.zeros((states.number, 0))
    return matrix(given[name], (*PLANT, name), problems, height=Size(states.number, "one per state"))


def _inputs(given: Mapping[str, Any], B: Array | None, problems: Problems) -> tuple[str, ...] | None:
    names, path = given.get("inputs"), (*PLANT, "inputs")
    if names is None:
        return None
    for k, name in enumerate(names):
        if name in names[:k]:
            problems.at((*path, k), f"the input {name} is named twice")
    if B is not None and not has_length(names, path, problems, Size(B.shape[1], "one name per column of B")):
        return None
    return tuple(names)


def _step(given: Mapping[str, Any], run: Mapping[str, Any], problems: Problems) -> float | None:
    """Seconds between samples: the plant's period or the run's step, whichever belongs to the plant's time."""
    if "time" not in given:
        return None
    period, step = (*PLANT, "period"), ("run", "step")
    mine, other = (period, step) if given["time"] == "discrete" else (step, period)
    values = {period: given.get("period"), step: run.get("step")}
    known = {period: "period" in given, step: "step" in run}
    if values[other] is not None:
        problems.at_key(other, f"does not belong to a {given['time']} plant")
    if values[mine] is None and known[mine]:
        problems.at_key(mine, f"is missing: a {given['time']} plant needs it (seconds per sample)")
    return values[mine]


def _initial(given: Mapping[str, Any], states: Size | None, problems: Problems) -> Array | model.Normal | None:
    x0, path = given.get("x0"), (*PLANT, "x0")
    if x0 is None or states is None:
        return None
    if isinstance(x0, list):
        return vector(x0, path, problems, states)
    mean = _spread(x0.normal.mean, (*path, "normal", "mean"), states, problems)
    std = _spread(x0.normal.std, (*path, "normal", "std"), states, problems)
    return None if mean is None or std is None else model.Normal(mean, std)


def _spread(written: float | list[float], path: Path, size: Size, problems: Problems) -> Array | None:
    """A number for everybody, or one number each."""
    if isinstance(written, list):
        return vector(written, path, problems, size)
    return np.full(size.number, float(written))


def _control(
    given: Mapping[str, Any], states: Size | None, m: Size | None, inputs: tuple[str, ...] | None, problems: Problems
) -> model.Lqr | model.Feedback | model.OpenLoop | None:
    path = (*PLANT, "control")
    if "control" not in given or states is None or m is None:
        return None
    written: schema.Control | None = given["control"]
    if written is None:
        return model.OpenLoop((ZERO,) * m.number)
    if m.number == 0:
        problems.at_key(path, "the plant has no inputs (no B)")
        return None
    if written.signals is not None:
        return _open_loop(written.signals, m, inputs, problems)
    if written.F is not None:
        F = matrix(written.F, (*path, "F"), problems, height=m, width=states)
        reference = _reference(written.reference, path, states, problems)
        return None if F is None or reference is None else model.Feedback(F, reference)
    return _lqr(written.lqr, states, m, problems)


def _lqr(lqr: schema.LqrWeights | None, states: Size, m: Size, problems: Problems) -> model.Lqr | None:
    if lqr is None:
        return None
    path = (*PLANT, "control", "lqr")
    Q = weight(lqr.Q, (*path, "Q"), problems, states)
    R = weight(lqr.R, (*path, "R"), problems, m)
    if Q is not None and _smallest_eigenvalue(Q) < -1e-12 * np.abs(Q).max():
        problems.at((*path, "Q"), "should be positive semidefinite")
    if R is not None and _smallest_eigenvalue(R) <= 0:
        problems.at((*path, "R"), "should be positive definite")
    reference = _reference(lqr.reference, path, states, problems)
    return None if Q is None or R is None or reference is None else model.Lqr(Q, R, reference)


def _smallest_eigenvalue(M: Array) -> float:
    """Of a symmetric matrix; -inf when the entries are too large to tell."""
    try:
        return float(np.linalg.eigvalsh(M)[0])
    except np.linalg.LinAlgError:
        return -np.inf


def _reference(written: list[float] | None, path: Path, states: Size, problems: Problems) -> Array | None:
    if written is None:
        return np.zeros(states.number)
    return vector(written, (*path, "reference"), problems, states)


def _open_loop(
    written: dict[str, schema.Signal] | list[schema.Signal],
    m: Size,
    inputs: tuple[str, ...] | None,
    problems: Problems,
) -> model.OpenLoop | None:
    """One signal per input; in a mapping, inputs that are not named get none."""
    path = (*PLANT, "control", "signals")
    if isinstance(written, list):
        fits = has_length(written, path, problems, m)
        return model.OpenLoop(tuple(normalised(s) for s in written)) if fits else None
    if inputs is None:
        return None
    for name in written:
        if name not in inputs:
            near = did_you_mean(name, inputs) or f"; the inputs are {listed(inputs, 'and')}"
            problems.at_key((*path, name), f"no such input{near}")
    return model.OpenLoop(tuple(normalised(written[name]) if name in written else ZERO for name in inputs))


def _disturbance(given: Mapping[str, Any], E: Array | None, problems: Problems) -> tuple[model.Signal, ...] | None:
    if "disturbance" not in given or E is None:
        return None
    written, columns = given["disturbance"], Size(E.shape[1], "one signal per column of E")
    if written is None:
        return (ZERO,) * columns.number
    fits = has_length(written, (*PLANT, "disturbance"), problems, columns)
    return tuple(normalised(s) for s in written) if fits else None
