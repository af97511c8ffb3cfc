"""``--set path=value``: one value of the resolved file replaced, and known from then on by its argument."""

from __future__ import annotations

from typing import Any

from duio_mesh.scenario.problems import Path, Place, Problems, counted, listed
from duio_mesh.scenario.source import read_text
from duio_mesh.scenario.validate import describe


def apply_override(document: dict[str, Any], text: str, problems: Problems) -> None:
    """Replace one value in ``document``, or add a key to a mapping; mappings on the way are made when they are missing.

    The value is YAML under the same rules as a file. Every problem is reported as ``--set path=value: ...``.
    """
    place = Place(f"--set {text}")
    name, equals, written = text.partition("=")
    if not equals or not all(name.split(".")):
        problems.report(place, (), "should read path=value, for example run.steps=200")
        return
    scratch = Problems()
    target = _target(document, name.split("."), place, problems)
    if target is None:
        return
    holder, path = target
    value = read_text(written, place.source, path, scratch)
    problems.forget(path)
    problems.locate(path, place, place)
    problems.adopt(scratch, place)
    holder[path[-1]] = value


def _target(document: dict[str, Any], parts: list[str], place: Place, problems: Problems) -> tuple[Any, Path] | None:
    """The mapping or list that holds the value, and the value's path; None after a report."""
    holder: Any = document
    path: Path = ()
    for depth, part in enumerate(parts):
        last = depth == len(parts) - 1
        key = _key(holder, part, path, last, place, problems)
        if key is None:
            return None
        path = (*path, key)
        if last:
            return holder, path
        if isinstance(holder, dict) and holder.get(key) is None:
            holder[key] = {}
            problems.locate(path, place, place)
        holder = holder[key]
    return None


def _key(holder: Any, part: str, path: Path, last: bool, place: Place, problems: Problems) -> str | int | None:
    """``part`` as a key of this mapping or an index of this list."""
    if isinstance(holder, list):
        index = _whole(part)
        if index is not None and index < len(holder):
            return index
        problems.report(place, path, f"has {counted(len(holder), 'entry')}; there is no {part} (the first one is 0)")
    elif isinstance(holder, dict):
        if path == ("nodes",):
            node = _whole(part)
            key = part if node is None else node
            if last or key in holder:
                return key
            problems.report(place, (*path, part), f"no such node; the nodes are {listed(holder, 'and')}")
        else:
            return part
    else:
        problems.report(place, path, f"is {describe(holder)}; there is no {part} in it")
    return None


def _whole(part: str) -> int | None:
    return int(part) if part.isascii() and part.isdigit() and len(part) < 12 else None
