"""``python -m duio_mesh.schema [FILE]``: the JSON schema of topology files (topologies/schema.json)."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from duio_mesh.methods import METHODS
from duio_mesh.scenario.editor import editor_schema
from duio_mesh.synthesis import options_of


def text() -> str:
    """The schema with the options of every method."""
    return json.dumps(editor_schema({method: options_of(method) for method in METHODS}), indent=2) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Print the schema, or write it to the file that is named."""
    parser = argparse.ArgumentParser(description="The JSON schema of topology files, for editors.")
    parser.add_argument("file", nargs="?", type=Path, help="where to write it (default: standard output)")
    file = parser.parse_args(argv).file
    if file:
        file.write_text(text(), encoding="utf-8")
    else:
        sys.stdout.write(text())


if __name__ == "__main__":
    main()
