"""Where every value of a topology stands, and what is wrong with it: one line per problem, all of them at once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

from duio_mesh.errors import ScenarioError

Path: TypeAlias = tuple[str | int, ...]
"""The way to a value: keys and list indices from the top of the resolved topology; a plant file hangs under plant."""


class Place(NamedTuple):
    """A position in a file, or (line 0) a whole ``--set path=value`` argument."""

    source: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


class Problems:
    """Collects problems and knows the place of every path, so that checks need only name the path."""

    def __init__(self) -> None:
        self._values: dict[Path, Place] = {}
        self._keys: dict[Path, Place] = {}
        self._poisoned: set[Path] = set()  # values that the reader already rejected: nobody complains again
        self._found: dict[tuple[Place, str], None] = {}  # an ordered set

    def locate(self, path: Path, value: Place, key: Place | None = None) -> None:
        """The value at ``path`` stands here, and its key there (a plant file's top has none)."""
        self._values[path] = value
        if key is not None:
            self._keys[path] = key
        else:
            self._keys.pop(path, None)

    def forget(self, path: Path) -> None:
        """The value at ``path`` is about to be replaced: drop what is known about it and everything inside."""
        inside = len(path)
        for known in (self._values, self._keys):
            for p in [p for p in known if p[:inside] == path]:
                del known[p]
        self._poisoned = {p for p in self._poisoned if p[:inside] != path}

    def place(self, path: Path) -> Place:
        """Of the value at ``path``, or of the nearest mapping or list around it."""
        while path and path not in self._values:
            path = path[:-1]
        return self._values.get(path, Place("?", 1, 1))

    def key_place(self, path: Path) -> Place:
        """Of the key that leads to ``path``; of the value when there is no key."""
        return self._keys.get(path) or self.place(path)

    def report(self, place: Place, path: Path, message: str) -> None:
        """A problem at a known place."""
        self._found[place, f"{dotted(path)}: {message}" if path else message] = None

    def at(self, path: Path, message: str) -> None:
        """A problem with the value at ``path``."""
        if not self.silenced(path):
            self.report(self.place(path), path, message)

    def at_key(self, path: Path, message: str) -> None:
        """A problem with the key that leads to ``path`` (or with its absence: then shown at the key of its mapping)."""
        if not self.silenced(path):
            place = self._keys.get(path) or self.key_place(path[:-1])
            self.report(place, path, message)

    def poison(self, path: Path, place: Place, message: str) -> None:
        """The value at ``path`` cannot be used at all; later complaints about it are consequences and are dropped."""
        self.report(place, path, message)
        self._poisoned.add(path)

    def adopt(self, other: Problems, place: Place) -> None:
        """Take over what ``other`` found, all of it shown at ``place``."""
        self._found |= {(place, text): None for _, text in other._found}
        self._poisoned |= other._poisoned

    def silenced(self, path: Path) -> bool:
        """Has the value at ``path``, or one around it, been rejected by the reader?"""
        return any(path[:k] in self._poisoned for k in range(len(path) + 1))

    def silenced_inside(self, path: Path) -> bool:
        """Has a value inside the one at ``path`` been rejected by the reader?"""
        return any(p[: len(path)] == path for p in self._poisoned)

    def __bool__(self) -> bool:
        return bool(self._found)

    def check(self) -> None:
        """Raise ScenarioError with every problem, file by file in the order of the lines."""
        if not self._found:
            return
        places = [*self._values.values(), *(place for place, _ in self._found)]  # the topology's own top comes first
        files = list(dict.fromkeys(place.source for place in places))
        ordered = sorted(self._found, key=lambda f: (files.index(f[0].source), f[0].line, f[0].column))
        raise ScenarioError([_one_line(f"{place}: {text}") for place, text in ordered])


def dotted(path: Path) -> str:
    """nodes.1.C.0 for ('nodes', 1, 'C', 0)."""
    return ".".join(str(p) for p in path)


def _one_line(text: str) -> str:
    """Names and arguments come from the user: nothing in them may break a line or move the terminal's cursor."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def nearest(wrong: object, known: Iterable[object]) -> str | None:
    """The known word that was probably meant, None when nothing is near."""
    near = difflib.get_close_matches(str(wrong), [str(k) for k in known], n=1, cutoff=0.65)
    return near[0] if near else None  # at 0.65 lim is near lmi, but uniform is not near normal


def did_you_mean(wrong: object, known: Iterable[object]) -> str:
    """' (did you mean x?)', or '' when nothing is near."""
    near = nearest(wrong, known)
    return "" if near is None else f" (did you mean {near}?)"


def listed(words: Iterable[object], last: str = "or") -> str:
    """'a, b or c'."""
    *most, end = [str(w) for w in words] or ["nothing"]
    return f"{', '.join(most)} {last} {end}" if most else end


def counted(number: int, noun: str) -> str:
    """'1 entry', '3 entries'."""
    return f"{number} {noun if number == 1 else 'entries' if noun == 'entry' else noun + 's'}"
