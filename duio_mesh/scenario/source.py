"""YAML text -> plain data with the place of every key and value.

YAML 1.2 (core schema) without the parts that make files surprising: no anchors, aliases, tags, directives, duplicate
keys, NaN or infinities. ``ruamel.yaml`` parses; what a scalar means is decided here, so that nothing guesses later.
"""

from __future__ import annotations

import math
import re
from pathlib import Path as FilePath
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from duio_mesh.scenario.problems import Path, Place, Problems, did_you_mean

MAX_BYTES = 8 * 2**20
MAX_DEPTH = 16  # the deepest legal path (a parameter of a signal in a list in a node's noise) has 7 parts

_INT = re.compile(r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None} | dict.fromkeys(("true", "True", "TRUE"), True)
_WORDS |= dict.fromkeys(("false", "False", "FALSE"), False)
_UNPRINTABLE = re.compile("[^\t\n\r\x20-\x7e\x85\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def plain(text: str) -> Any:
    """What an unquoted scalar means in YAML 1.2: null, a boolean, a number (perhaps NaN or infinite) or text."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text, 0) if text[:2] in ("0o", "0x") else int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return float(text.replace(".", "", 1)) if _NOT_FINITE.fullmatch(text) else text


def read_file(path: FilePath, base: Path, problems: Problems, referred: Place | None = None) -> Any:
    """The data of a YAML file; places are noted under ``base``. None when a problem was found that leaves no data.

    A file that cannot be opened is reported at the reference to it when there is one (``referred``).
    """
    start = Place(str(path), 1, 1)

    def refuse(message: str) -> None:
        problems.poison(base, referred or start, message)

    try:
        if not path.is_file():
            near = [f.name for f in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
            kind = "is not a file" if path.exists() else "no such file"
            return refuse(f"{kind}: {path}{did_you_mean(path.name, near)}")
        with path.open("rb") as f:
            raw = f.read(MAX_BYTES + 1)
    except (OSError, ValueError) as e:  # ValueError: a NUL byte in the name
        return refuse(f"cannot be read: {path}: {getattr(e, 'strerror', None) or e}")
    if len(raw) > MAX_BYTES:
        return refuse(f"is larger than {MAX_BYTES // 2**20} MiB: {path}")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        before = raw[: e.start].decode("utf-8", "replace")
        problems.poison(base, _place_of(start.source, before), f"is not UTF-8 text (byte 0x{raw[e.start]:02x})")
        return None
    data = read_text(text, start.source, base, problems)
    if data is None and not problems.silenced(base):
        problems.poison(base, start, "the file is empty")
    return data


def read_text(text: str, source: str, base: Path, problems: Problems) -> Any:
    """The data of a YAML text (a file, or the value of an override with its own ``source``)."""
    bad = _UNPRINTABLE.search(text)
    if bad:
        place = _place_of(source, text[: bad.start()])
        problems.poison(base, place, f"is not text: it holds the control character U+{ord(bad[0]):04X}")
        return None
    directive = re.match(r"(?:\s*(?:#.*)?\n)*%", text)
    if directive:
        problems.poison(base, _place_of(source, directive[0][:-1]), "YAML directives are not part of a topology file")
        return None
    try:
        root = YAML(typ="safe", pure=True).compose(text)
    except MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        since = f" ({e.context} that starts on line {e.context_mark.line + 1})" if e.context_mark and e.context else ""
        place = Place(source, mark.line + 1, mark.column + 1)
        problems.poison(base, place, f"is not valid YAML: {e.problem}{since}".replace("\n", " "))
        return None
    except (YAMLError, ValueError, RecursionError) as e:
        what = "lists or mappings are nested too deeply" if isinstance(e, RecursionError) else str(e).split("\n")[0]
        problems.poison(base, Place(source, 1, 1), f"is not valid YAML: {what}")
        return None
    if root is None:
        return None
    return _Builder(text, source, problems).value(root, base, None)


def _place_of(source: str, before: str) -> Place:
    lines = re.split("\r\n|[\r\n\x85\u2028\u2029]", before)
    return Place(source, len(lines), len(lines[-1]) + 1)


class _Builder:
    """Nodes -> plain dicts, lists and scalars; what cannot stand becomes None and is reported."""

    def __init__(self, text: str, source: str, problems: Problems) -> None:
        self._text, self._source, self._problems = text, source, problems
        self._anchored: set[int] = set()

    def value(self, node: MappingNode | SequenceNode | ScalarNode, path: Path, key: Place | None) -> Any:
        place = self._place(node)
        elsewhere = node.start_mark.index == node.end_mark.index or id(node) in self._anchored
        self._problems.locate(path, key if elsewhere and key else place, key)
        if self._decorated(node, path, place):
            return None
        if len(path) > MAX_DEPTH:
            self._problems.poison(path, place, "is nested too deeply")
            return None
        if isinstance(node, MappingNode):
            return self._mapping(node, path)
        if isinstance(node, SequenceNode):
            return [self.value(child, (*path, k), None) for k, child in enumerate(node.value)]
        return self._scalar(node, path, place)

    def _place(self, node: Node) -> Place:
        return Place(self._source, node.start_mark.line + 1, node.start_mark.column + 1)

    def _decorated(self, node: Node, path: Path, place: Place) -> bool:
        """Anchors and tags come first in a node's text; nothing else can start with these characters."""
        first = self._text[node.start_mark.index : node.start_mark.index + 1]
        if id(node) in self._anchored:  # an alias is its anchor's node again, and has no place of its own
            around = self._problems.key_place(path[:-1] if isinstance(path[-1], int) else path)
            self._problems.poison(path, around, f"aliases (*{node.anchor}) are not allowed: write the value out")
        elif first == "&" or node.anchor:
            self._anchored.add(id(node))
            self._problems.poison(path, place, f"anchors (&{node.anchor}) are not allowed: write the value out")
        elif first == "!":
            self._problems.poison(path, place, f"tags ({node.tag}) are not allowed: write the plain value")
        else:
            return False
        return True

    def _mapping(self, node: MappingNode, path: Path) -> dict[str | int, Any]:
        data: dict[str | int, Any] = {}
        first: dict[str | int, Place] = {}
        for key_node, value_node in node.value:
            place = self._place(key_node)
            key = self._key(key_node, path, place)
            if key is None:
                continue
            if key in data:
                self._problems.report(place, (*path, key), f"is given twice, first on line {first[key].line}")
                continue
            first[key] = place
            data[key] = self.value(value_node, (*path, key), place)
        return data

    def _key(self, node: Node, path: Path, place: Place) -> str | int | None:
        if self._decorated(node, (*path, "?"), place):
            return None
        if not isinstance(node, ScalarNode):
            self._problems.report(place, path, "a list or mapping cannot be a key")
            return None
        if _UNPRINTABLE.search(node.value):
            self._problems.report(place, path, "a key holds a control character")
            return None
        key = node.value if node.style else plain(node.value) if len(node.value) < 100 else node.value
        if isinstance(key, str) or (path == ("nodes",) and type(key) is int):
            return key
        self._problems.report(place, path, f"the key {node.value or 'null'} should be text; put it in quotes")
        return None

    def _scalar(self, node: ScalarNode, path: Path, place: Place) -> Any:
        bad = _UNPRINTABLE.search(node.value)  # an escape in quotes, for the file itself has none
        if bad:
            self._problems.poison(path, place, f"holds the control character U+{ord(bad[0]):04X}")
            return None
        if node.style:
            return node.value
        try:
            value = plain(node.value)
        except ValueError:  # an integer of thousands of digits
            value = math.inf
        if isinstance(value, float) and not math.isfinite(value):
            self._problems.poison(path, place, f"should be a finite number, not {_short(node.value)}")
            return None
        if type(value) is int and abs(value) >= 2**63:
            self._problems.poison(path, place, f"is too large for a whole number: {_short(node.value)}")
            return None
        return value


def _short(text: str) -> str:
    return text if len(text) <= 40 else f"{text[:37]}..."
