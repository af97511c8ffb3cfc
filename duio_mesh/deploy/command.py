"""`launch.py export` and `launch.py gather`: from a design to what each host's containers need, and back to results."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from duio_mesh import __version__
from duio_mesh.errors import DesignError, RunError, ScenarioError

IMAGE = f"duio_mesh:{__version__}"
START = 600.0  # seconds
_HOST = r"(?:[A-Za-z0-9.-]+|\[[0-9A-Fa-f:]+\])(?::[0-9]+)?"
_NAME = r"[a-z0-9]+(?:(?:\.|_{1,2}|-+)[a-z0-9]+)*"
_REFERENCE = re.compile(  # as in the distribution project: [host[:port]/]name[/name][:tag][@digest]
    rf"(?:{_HOST}/)?{_NAME}(?:/{_NAME})*(?::\w[\w.-]{{0,127}})?(?:@[A-Za-z][\w.+-]*:[0-9A-Fa-f]{{32,}})?", re.ASCII
)
DONE, NOT_CONVERGED, IMPOSSIBLE, FAILED = 0, 1, 2, 3

EXPORT = """\
RUN_DIR holds a design: what `launch.py TOPOLOGY --dry-run --out RUN_DIR` writes, or the folder of any run.
Every export is a run of its own: it has its own name on the wire and, with security: mtls, its own certificates
(valid for 30 days) that only work with each other.

examples:
  python launch.py topologies/three_hosts.yaml --dry-run --out runs/site
  python launch.py export runs/site --compose
  python launch.py export runs/site --kubernetes --image registry.example/duio_mesh:0.1.0
"""

GATHER = """\
RUN_DIR holds the design that was exported. Below the folders, every node-<id>.f64, plant.f64 (rows) and *.jsonl (logs)
counts: each process' own, and what the recorder wrote down of everybody.
Exit codes are those of a run: 0 converged, 1 not converged, 2 no design, 3 a process failed.

example:
  python launch.py gather runs/site collected/hall collected/north collected/south
"""


def main(argv: Sequence[str]) -> int:
    """Run ``export ...`` or ``gather ...``; the exit code."""
    verb, rest = argv[0], argv[1:]
    try:
        return export(rest) if verb == "export" else gather(rest)
    except (ScenarioError, DesignError) as e:
        print(e, file=sys.stderr)
        return IMPOSSIBLE
    except (RunError, OSError) as e:
        print(f"{verb} failed: {e}", file=sys.stderr)
        return FAILED


def export(argv: Sequence[str]) -> int:
    """Write what every container needs."""
    p = _parser("export", "Write compose files or Kubernetes objects for a run over many hosts.", EXPORT)
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder with a design")
    how = p.add_mutually_exclusive_group(required=True)
    how.add_argument("--compose", action="store_true", help="one compose.yaml per host of the topology")
    how.add_argument("--kubernetes", action="store_true", help="secrets.yaml, run.yaml and results.yaml")
    p.add_argument("--out", type=Path, metavar="DIR", help="where to (default RUN_DIR/compose or RUN_DIR/kubernetes)")
    p.add_argument("--image", type=_image, default=IMAGE, help=f"container image (default {IMAGE})")
    p.add_argument(
        "--start-within",
        type=float,
        default=START,
        metavar="SECONDS",
        help=f"all processes have to be there so soon after the first (default {START:g})",
    )
    args = p.parse_args(argv)
    if not args.start_within > 0:
        p.error("--start-within should be greater than 0")
    from duio_mesh.deploy import compose, kubernetes, stored

    design = stored.read_design(args.run)
    out = args.out or args.run / ("compose" if args.compose else "kubernetes")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ScenarioError([f"{out} already exists and is not empty; an export is never overwritten (--out DIR)"])
    write = compose.export if args.compose else kubernetes.export
    for path in write(design, out, args.image, args.start_within):
        print(path)
    return DONE


def _image(text: str) -> str:
    if not _REFERENCE.fullmatch(text):
        raise argparse.ArgumentTypeError(f"should be an image like registry.example/duio_mesh:0.1.0, not {text!r}")
    return text


def gather(argv: Sequence[str]) -> int:
    """Make trace.npz, metrics.json and recording.rrd of what was collected."""
    p = _parser("gather", "Make the results of a run over many hosts from what its processes wrote.", GATHER)
    p.add_argument("run", type=Path, metavar="RUN_DIR", help="folder with the design that was exported")
    p.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="collected from the hosts")
    p.add_argument("--out", type=Path, metavar="DIR", help="where to (default RUN_DIR)")
    args = p.parse_args(argv)
    from duio_mesh import console
    from duio_mesh.deploy import gather as gathering

    design, result = gathering.gather(args.run, args.folders, args.out)
    console.result(design, result, live=False)
    return DONE if result.converged else NOT_CONVERGED


def _parser(verb: str, what: str, epilog: str) -> argparse.ArgumentParser:
    return argparse.ArgumentParser(
        prog=f"launch.py {verb}",
        description=what,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
