"""``external:``, a plant whose measurements come from outside: which node hears which keys, and where."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path as FilePath
from typing import Any

from duio_mesh.scenario import model, schema
from duio_mesh.scenario.plant import PLANT
from duio_mesh.scenario.problems import Path, Problems, counted, did_you_mean
from duio_mesh.scenario.source import read_file
from duio_mesh.scenario.validate import whole
from duio_mesh.sensors.messages import SCALAR
from duio_mesh.spec import Outside

WORD = "external"
EXTERNAL: Path = (WORD,)
LISTEN = "tcp/127.0.0.1:7447"  # Zenoh's own port, on this host only
_ENDPOINT = re.compile(r"tcp/(?P<host>\[[0-9A-Fa-f:.]+\]|[^\s:/\[\]]+):(?P<port>[1-9][0-9]{0,4})")
_NODE = "{node}"  # in external.key: the id of the node
_BRACES = re.compile(r"\{[^{}]*\}")
_CHUNK = re.compile(r"[^/*#?$\s]+|\*")  # of a key expression; ** and $* are more than is needed here


def resolve_model(document: dict[str, Any], folder: FilePath, problems: Problems) -> None:
    """``plant: external``: what ``external.model`` names becomes the plant."""
    if document.get("plant") != WORD:
        return
    external = document.get(WORD)
    if not isinstance(external, dict) or not isinstance(external.get("model"), str):
        hint = "external needs 'external: {model: FILE, key: ...}' beside it (docs/sensors.md)"
        problems.poison(PLANT, problems.place(PLANT), hint)
        document["plant"] = None
        return
    place = problems.place((*EXTERNAL, "model"))
    name = external.pop("model")
    problems.forget((*EXTERNAL, "model"))
    document["plant"] = read_file(folder / name, PLANT, problems, referred=place)


def read_external(
    document: Mapping[str, Any], nodes: Mapping[int, model.Node | None] | None, problems: Problems
) -> Outside | None:
    """Where the samples come from, or None: the plant is simulated. ``nodes`` as ``read_nodes`` gives them."""
    raw = document.get("nodes")
    own = {i: node["keys"] for i, node in raw.items() if _has_keys(node)} if isinstance(raw, Mapping) else {}
    if document.get(WORD) is None:
        for i in own:
            problems.at_key(("nodes", i, "keys"), "belongs to plant: external")
        return None
    written = whole(schema.External, document[WORD], EXTERNAL, problems)
    if written is None or nodes is None:
        return None
    if written.model is not None:
        problems.at_key((*EXTERNAL, "model"), "belongs to 'plant: external'; to take another model: plant: FILE")
    _check_run(document, written.hold, problems)
    _check_endpoints(written, problems)
    for name in ("key", "end"):
        _check_key((getattr(written, name) or "x").replace("{node}", "1"), (*EXTERNAL, name), problems)
    template = _template(written.key, [i for i in nodes if i not in own], problems)
    feeds = {i: _feed(i, own.get(i), template, problems) for i in nodes}
    sizes: dict[str, int] = {}
    for i, node in nodes.items():
        if node is not None:
            _add_sizes(sizes, node, feeds[i], written.encoding, problems)
    if written.end in sizes:
        problems.at((*EXTERNAL, "end"), "is the key of a sensor")
    strays = (written.key or "").replace("{node}", "*")
    return Outside(
        listen="" if written.connect else written.listen or LISTEN,
        connect=written.connect or "",
        encoding=written.encoding,
        feeds=feeds,
        sizes=sizes,
        strays=strays if any(key != strays for key in sizes) and (written.key or "").count("*") == 0 else "",
        end=written.end or "",
        hold=inf if written.hold is None else written.hold,
        start_within=written.start_within,
    )


def _has_keys(node: Any) -> bool:
    return isinstance(node, Mapping) and node.get("keys") is not None


def _check_run(document: Mapping[str, Any], hold: float | None, problems: Problems) -> None:
    """What does not go together with samples that come when they come."""
    run, timing = document.get("run"), document.get("timing")
    if isinstance(run, Mapping) and run.get("batch", 1) != 1:
        problems.at(("run", "batch"), "should be 1: samples from outside come one by one")
    deadline = run.get("deadline", schema.Run.model_fields["deadline"].default) if isinstance(run, Mapping) else inf
    if hold is not None and isinstance(deadline, int | float) and hold >= deadline:
        problems.at((*EXTERNAL, "hold"), f"should be less than run.deadline, {deadline:g} s, when the run fails")
    if document.get("hosts") is not None:
        problems.at_key(("hosts",), "does not go with plant: external; the gateway's own host is the run's")
    if (timing.get("mode") if isinstance(timing, Mapping) else timing) not in (None, "lockstep"):
        problems.at(("timing",), "should be lockstep: with plant: external the sensors set the pace")


def _check_endpoints(written: schema.External, problems: Problems) -> None:
    for name in ("listen", "connect"):
        value = getattr(written, name)
        path = (*EXTERNAL, name)
        parts = _ENDPOINT.fullmatch(value) if value else None
        if value and not (parts and int(parts["port"]) < 65536):
            problems.at(path, f"should be a Zenoh endpoint like tcp/127.0.0.1:7447, not {value}")
        elif parts and name == "listen" and not written.exposed and not _loopback(parts["host"].strip("[]")):
            problems.at(
                path,
                "lets everybody who reaches that port publish measurements; say so with exposed: true, or connect to "
                "a router (docs/sensors.md)",
            )


def _loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _check_key(key: str, path: Path, problems: Problems) -> None:
    if not all(_CHUNK.fullmatch(chunk) for chunk in key.split("/")):
        problems.at(path, f"should be a Zenoh key like building/3/y ('*' for any one part), not {key[:80]}")


def _template(key: str | None, users: Sequence[int], problems: Problems) -> str | None:
    """``external.key``, whose users are the nodes without keys of their own; something like it after a report."""
    if key is None:
        return None
    path = (*EXTERNAL, "key")
    strangers = [name for name in _BRACES.findall(key) if name != _NODE]
    for name in strangers:
        hint = did_you_mean(name, [_NODE]) or f"; only {_NODE} is, by the id of the node"
        problems.at(path, f"{name} is not replaced by anything{hint}")
    if _NODE in key or len(users) < 2:
        return key
    if not strangers:
        problems.at(
            path, f"should have {_NODE} in it: {len(users)} nodes have no keys of their own, and share this one"
        )
    return _NODE  # a key each, so that nothing follows from the mistake


def _feed(i: int, own: Any, template: str | None, problems: Problems) -> tuple[str, ...]:
    """The keys of node i, in the order of its numbers."""
    path: Path = ("nodes", i, "keys")
    if own is None:
        if template is None:
            problems.at_key(path, "is missing: external.key is not given, so every node needs its own keys")
            return ()
        return (template.replace("{node}", str(i)),)
    keys = (own,) if isinstance(own, str) else tuple(own) if isinstance(own, list) else ()
    keys = tuple(key for key in keys if isinstance(key, str))  # of another kind: reported with the node
    for n, key in enumerate(keys):
        _check_key(key, path if isinstance(own, str) else (*path, n), problems)
    return keys


def _add_sizes(
    sizes: dict[str, int], node: model.Node, keys: tuple[str, ...], encoding: str, problems: Problems
) -> None:
    """How many numbers each key of a node carries: all of them, or one each."""
    p, m = node.C.shape[0], len(node.knows)
    path: Path = ("nodes", node.id, "keys")
    needs = counted(p, "measurement") + (f" and {counted(m, 'input')}" if m else "")
    if encoding in SCALAR and len(keys) != p + m:
        problems.at_key(path, f"should be a list of {p + m} ({needs}): a {encoding} holds one number")
    elif len(keys) not in (1, p + m):
        problems.at(path, f"should be one key for all numbers, or {p + m} ({needs}), not {len(keys)}")
    else:
        for key in keys:
            size = p + m if len(keys) == 1 else 1
            if sizes.setdefault(key, size) != size:
                problems.at_key(path, f"{key} carries {sizes[key]} of another node's numbers, and {size} of this one's")
