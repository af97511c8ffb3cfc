"""`python -m duio_mesh.health --spec node-3.spec`: whether that process is alive; what a container's health check runs.

Ends with 0 when its liveliness token is seen, with 1 when not, with 2 when the spec cannot be used.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from duio_mesh.mesh.probe import alive
from duio_mesh.spec import NodeSpec, PlantSpec, RecorderSpec, RouterSpec, Wire, read_spec

TIMEOUT = 3.0  # seconds for connection and answer
ALIVE, NOT_ALIVE, UNUSABLE = 0, 1, 2


def wire_of(path: Path) -> Wire:
    """The wire in the spec of any process. Raises ValueError, or OSError, when that is none."""
    match path.stem.split("-")[0]:
        case "node":
            return read_spec(path, NodeSpec).wire
        case "plant":
            return read_spec(path, PlantSpec).wire
        case "recorder":
            return read_spec(path, RecorderSpec).wire
        case "router":
            return read_spec(path, RouterSpec).wire
    raise ValueError("its name should begin with node, plant, recorder or router")


def main() -> int:
    """The command line; the exit code."""
    parser = argparse.ArgumentParser(prog="python -m duio_mesh.health", description=__doc__)
    parser.add_argument("--spec", type=Path, required=True, help="the process' own spec")
    parser.add_argument("--timeout", type=float, default=TIMEOUT, metavar="SECONDS", help=f"default {TIMEOUT:g}")
    args = parser.parse_args()
    who = args.spec.stem
    try:
        seen = alive(wire_of(args.spec), who, args.timeout)
    except (OSError, ValueError) as e:
        print(f"{args.spec}: not the spec of a process: {e}", file=sys.stderr)
        return UNUSABLE
    print(f"{who} is {'alive' if seen else 'not to be seen'}")
    return ALIVE if seen else NOT_ALIVE


if __name__ == "__main__":
    code = main()
    sys.stdout.flush()
    os._exit(code)  # a peer that hangs shall not keep us
