"""From the path of a topology file to a Scenario, or to every problem in it."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel

from duio_mesh.methods import METHODS
from duio_mesh.scenario import model, schema
from duio_mesh.scenario.disturbed import read_faults
from duio_mesh.scenario.external import read_external, resolve_model
from duio_mesh.scenario.hosts import read_hosts
from duio_mesh.scenario.network import read_graph, read_nodes
from duio_mesh.scenario.overrides import apply_override
from duio_mesh.scenario.plant import PLANT, PlantParts, read_plant
from duio_mesh.scenario.problems import Problems, did_you_mean, listed
from duio_mesh.scenario.source import read_file
from duio_mesh.scenario.timing import read_timing
from duio_mesh.scenario.validate import describe, fields, whole

OptionsOf = Callable[[str], type[BaseModel]]


def load_scenario(path: str | FilePath, overrides: Iterable[str] = (), *, options_of: OptionsOf) -> model.Scenario:
    """The topology file at ``path``, resolved and checked.

    ``overrides`` are ``dotted.path=value`` texts (the command line's ``--set``), applied in order to the resolved file
    and checked like it. ``options_of`` gives a method's model of its keys under ``observer:``.
    Raises ScenarioError with every problem in the file, its plant file and the overrides.
    """
    path, problems = FilePath(path), Problems()
    document = read_file(path, (), problems)
    if isinstance(document, dict):
        _resolve_plant(document, path.parent, problems)
        for text in overrides:
            apply_override(document, text, problems)
            _resolve_plant(document, path.parent, problems)
        scenario = _scenario(document, problems, options_of)
        problems.check()
        assert scenario is not None, "a scenario without problems is complete"  # noqa: S101
        return scenario
    problems.at((), f"a topology file should be a mapping, not {describe(document)}")
    problems.check()
    raise AssertionError("unreachable: there is a problem")


def _resolve_plant(document: dict[str, Any], folder: FilePath, problems: Problems) -> None:
    """Replace the name of a plant file by what the file holds."""
    resolve_model(document, folder, problems)
    name = document.get("plant")
    if isinstance(name, str):
        place = problems.place(PLANT)
        problems.forget(PLANT)
        problems.locate(PLANT, place)
        document["plant"] = read_file(folder / name, PLANT, problems, referred=place)


def _scenario(document: dict[str, Any], problems: Problems, options_of: OptionsOf) -> model.Scenario | None:
    """The scenario when the document has no problem."""
    _check_keys(document, problems)
    heading = fields(
        schema.Heading, {k: document[k] for k in schema.Heading.model_fields if k in document}, (), problems
    )
    run = fields(schema.Run, document["run"], ("run",), problems) if "run" in document else {}
    parts = read_plant(document["plant"], run, problems) if "plant" in document else PlantParts(None, None, None, None)
    nodes = read_nodes(document["nodes"], parts, problems) if "nodes" in document else None
    graph = read_graph(document["graph"], nodes, problems) if "graph" in document else None
    method, options = _observer(document["observer"], problems, options_of) if "observer" in document else ("", None)
    settings = _run(run, len(nodes or ()) * (parts.states.number if parts.states else 0), problems)
    faults = read_faults(document.get("faults"), graph, run, problems)
    security = _security(document, problems)
    hosts = read_hosts(document, nodes, security, problems)
    timing = read_timing(document, parts.plant, run, problems)
    outside = read_external(document, nodes, problems)
    if problems or parts.plant is None or nodes is None or graph is None or settings is None:
        return None
    resolved = copy.deepcopy(document)
    resolved["run"]["seed"] = settings.seed
    sound = {i: node for i, node in nodes.items() if node is not None}
    return model.Scenario(
        heading["name"],
        heading["description"],
        parts.plant,
        method,
        options,
        sound,
        graph,
        settings,
        resolved,
        faults,
        security,
        timing,
        outside,
        hosts=hosts,
    )


def _check_keys(document: dict[str, Any], problems: Problems) -> None:
    known = schema.Topology.model_fields
    for key in document:
        if key in schema.RESERVED:
            problems.at_key((key,), schema.RESERVED[key])
        elif key not in known:
            near = did_you_mean(key, known) or f"; the keys here are {listed(known, 'and')}"
            problems.at_key((key,), f"unknown key{near}")
    for key, field in known.items():
        if field.is_required() and key not in document and key not in schema.Heading.model_fields:
            problems.at_key((key,), "is missing")


def _observer(written: Any, problems: Problems, options_of: OptionsOf) -> tuple[str, BaseModel | None]:
    """The method's name and its own options."""
    path = ("observer",)
    if not isinstance(written, dict):
        problems.at(path, f"should be a mapping, not {describe(written)}")
        return "", None
    method = written.get("method")
    if "method" not in written:
        problems.at_key((*path, "method"), f"is missing; the methods are {listed(METHODS, 'and')}")
    elif method not in METHODS:
        near = did_you_mean(method, METHODS) or f"; the methods are {listed(METHODS, 'and')}"
        problems.at((*path, "method"), f"no such method: {describe(method)}{near}")
    else:
        options = {key: value for key, value in written.items() if key != "method"}
        return str(method), whole(options_of(str(method)), options, path, problems)
    return "", None


def _security(document: dict[str, Any], problems: Problems) -> model.Security:
    """Who may speak: a mode, or a mapping with one."""
    if document.get("security") is None:
        return model.OPEN
    written = fields(schema.Protected, {"security": document["security"]}, (), problems).get("security", "open")
    if isinstance(written, schema.Security):
        return model.Security(written.mode, written.keep, written.exposed)
    return model.Security(written)


def _run(run: dict[str, Any], numbers: int, problems: Problems) -> model.Run | None:
    """The run's settings; ``numbers`` is what all nodes together estimate in one step."""
    if numbers and run.get("steps", 0) * numbers > schema.MAX_TRACE:
        most = schema.MAX_TRACE // numbers
        problems.at(
            ("run", "steps"), f"should be at most {most} with so many nodes and states (the trace would not fit)"
        )
    if not schema.Run.model_fields.keys() <= run.keys():
        return None
    verdict = model.Convergence(**run["convergence"].model_dump())
    settings = {key: run[key] for key in model.Run.__dataclass_fields__ if key != "convergence"}
    return model.Run(convergence=verdict, **settings)
