"""A topology as plain data, and its text: the only place that knows how a generated file looks."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from duio_mesh.arrays import Array

Path = tuple[str | int, ...]

WIDTH = 120
BLOCKS = ("plant", "observer", "nodes", "graph", "run")
"""Mappings that stand on lines of their own, and so do the nodes; all others are written {like: this}."""
PLAIN = re.compile(r"(?i)(?!(?:true|false|null)$)(?:[A-Za-z][A-Za-z0-9_ ./()+-]*[A-Za-z0-9_)]|[A-Za-z])")


class Document(NamedTuple):
    """What the file says, and what is explained in it."""

    content: Mapping[str, Any]
    """As the topology file's keys (docs/topology-file.md); numbers, texts, lists, mappings and numpy arrays."""
    heading: str
    """The comment at the top; paragraphs are separated by empty lines."""
    comments: Mapping[Path, str]
    """Comments above keys, by the path of the key."""


def text(document: Document) -> str:
    """The document as YAML. Every number is written so that it is read back as the same float64."""
    lines = _comment(document.heading, "")
    lines += _block(document.content, (), document.comments)
    return "\n".join(lines) + "\n"


def _block(content: Mapping[Any, Any], path: Path, comments: Mapping[Path, str]) -> list[str]:
    """A mapping, one key or more lines per key."""
    lines, indent = [], "  " * len(path)
    for key, value in content.items():
        here = (*path, key)
        lines += _comment(comments.get(here, ""), indent)
        if isinstance(value, Mapping) and (here[-1] in BLOCKS or here[:-1] == ("nodes",)):
            lines += [f"{indent}{key}:", *_block(value, here, comments)]
        elif isinstance(value, np.ndarray) and value.ndim == 2:
            lines += [f"{indent}{key}:", *(f"{indent}  - {flow(row)}" for row in value)]
        else:
            lines += _line(f"{indent}{key}: ", value)
    return lines


def _line(start: str, value: Any) -> list[str]:
    """A key and its value on one line, or a long list on several that end between two items."""
    whole = start + flow(value)
    if len(whole) <= WIDTH or not isinstance(value, list):
        return [whole]
    indent = " " * (len(start) - len(start.lstrip()) + 2)
    lines = [start + "["]
    for item in map(flow, value):
        if lines[-1].endswith("[") or len(lines[-1]) + len(item) + 2 > WIDTH:
            lines.append(f"{indent}{item},")
        else:
            lines[-1] += f" {item},"
    lines[-1] = lines[-1].removesuffix(",") + "]"
    return lines


def flow(value: Any) -> str:
    """The value on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) else json.dumps(value, ensure_ascii=False)
    if isinstance(value, np.ndarray | Sequence):
        return "[" + ", ".join(flow(item) for item in value) + "]"
    return _number(value)


def _number(value: float) -> str:
    """The shortest decimal that is read as the same number; whole ones without a point, and no negative zero."""
    if isinstance(value, int | np.integer):
        return str(int(value))
    if not np.isfinite(value):
        raise ValueError(f"not a finite number: {value}")
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(float(value))


def _comment(words: str, indent: str) -> list[str]:
    mark = indent + "# "
    lines: list[str] = []
    for paragraph in filter(None, words.split("\n\n")):
        if lines:
            lines.append(indent + "#")
        lines += textwrap.wrap(
            " ".join(paragraph.split()), WIDTH, initial_indent=mark, subsequent_indent=mark, break_on_hyphens=False
        )
    return lines


def rows(n: int, *indices: int) -> Array:
    """(len(indices), n): the measurement of these states, counted from 0."""
    return np.eye(n)[list(indices)]
