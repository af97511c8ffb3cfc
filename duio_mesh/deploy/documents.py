"""Plain data -> YAML that every parser reads alike: what a version of YAML could misread is quoted."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import SafeRepresenter

_SAFE = re.compile(r"[A-Za-z./][A-Za-z0-9_./-]*")
_WORDS = frozenset(("y", "n", "yes", "no", "on", "off", "true", "false", "null", ".inf", ".nan"))


class _Representer(SafeRepresenter):
    def text(self, value: str) -> ScalarNode:
        plain = _SAFE.fullmatch(value) and value.lower() not in _WORDS
        style = None if plain else "|" if "\n" in value else '"'
        return self.represent_scalar("tag:yaml.org,2002:str", value, style=style)

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Representer.add_representer(str, _Representer.text)


def write_documents(path: Path, head: str, documents: Iterable[Mapping[str, Any]], mode: int = 0o644) -> None:
    """Write a YAML file with these documents, ``head`` as comments at its top."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = False
    yaml.width = 2**20
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    out = io.StringIO()
    out.write("".join(f"# {line}\n" for line in head.splitlines()))
    yaml.explicit_start = True
    yaml.dump_all([dict(document) for document in documents], out)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "w", encoding="utf-8") as f:
        f.write(out.getvalue())
