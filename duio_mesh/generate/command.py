"""`python launch.py new KIND ...`: the options of the generator, and the file that it writes."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from duio_mesh.errors import ScenarioError
from duio_mesh.generate.document import Document, text
from duio_mesh.generate.graphs import NAMES

WRITTEN, IMPOSSIBLE = 0, 2

EPILOG = """\
The same options write the same file. An existing file is never overwritten (exit 2).

examples:
  python launch.py new heat --rooms 3x3 --nodes 4 --out topologies/heat3x3.yaml
  python launch.py new platoon --vehicles 12 --graph path --out topologies/platoon12.yaml
  python launch.py new swing --case 39 --out topologies/swing39.yaml
then
  python launch.py topologies/heat3x3.yaml --check
"""


def parser() -> argparse.ArgumentParser:
    """The options of `new`."""
    p = argparse.ArgumentParser(
        prog="launch.py new",
        description="Write a commented topology file for a system of the wanted size (docs/generate.md).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    kinds = p.add_subparsers(dest="kind", required=True, metavar="KIND")
    _heat(kinds.add_parser("heat", help="rooms of a building with HVAC units; discrete"))
    _swing(kinds.add_parser("swing", help="machines of an IEEE power grid; continuous, or sampled"))
    _platoon(kinds.add_parser("platoon", help="vehicles in a row, an observer in each; discrete"))
    return p


def _common(p: argparse.ArgumentParser, methods: Sequence[str], graph: str, expect: str) -> None:
    p.add_argument("--graph", choices=NAMES, default=graph, help=f"who talks to whom (default {graph})")
    p.add_argument("--method", choices=methods, default=methods[0], help=f"the observer (default {methods[0]})")
    p.add_argument("--seed", type=_count, default=0, metavar="S", help="of everything random in the file (default 0)")
    p.add_argument("--out", type=Path, metavar="FILE", help="where to write it (default: standard output)")
    p.epilog = expect


def _heat(p: argparse.ArgumentParser) -> None:
    from duio_mesh.generate.heat import METHODS, Heat, document

    p.add_argument("--rooms", type=_rooms, required=True, metavar="RxC", help="rows and columns of rooms, e.g. 8x8")
    p.add_argument("--nodes", type=_count, required=True, metavar="N", help="observers, at most one per room")
    p.add_argument("--hvac", type=_count, metavar="H", help="HVAC units (default: one per node, at most 4)")
    p.add_argument(
        "--own-rooms",
        type=_count,
        default=0,
        metavar="K",
        help="rooms that a node measures beside those that it must (default 0). With some, every node filters by "
        "itself (decomposition: detectability, local_gain: h2), without large matrix inequalities",
    )
    expect = (
        "Without --own-rooms the design of lmi solves a matrix inequality of nodes x (rooms - measurements) rows: two "
        "seconds for 12x12 rooms and 8 nodes, half a minute for 8x8 and 64. With --own-rooms there is none. augmented "
        "handles some 100 rooms x nodes and refuses more than 1000. Larger systems are written all the same."
    )
    _common(p, METHODS, "ring", expect)

    def make(a: argparse.Namespace) -> Document:
        height, width = a.rooms
        return document(Heat(height, width, a.nodes, a.graph, a.hvac, a.own_rooms, a.method, a.seed))

    p.set_defaults(make=make)


def _platoon(p: argparse.ArgumentParser) -> None:
    from duio_mesh.generate.platoon import METHODS, Platoon, document

    p.add_argument("--vehicles", type=_count, required=True, metavar="V", help="vehicles; each is a node")
    expect = (
        "The design takes seconds, but half a minute and more on random graphs of 32 nodes and more (fusion: admm)."
    )
    _common(p, METHODS, "path", expect)
    p.set_defaults(make=lambda a: document(Platoon(a.vehicles, a.graph, a.method, a.seed)))


def _swing(p: argparse.ArgumentParser) -> None:
    from duio_mesh.generate.swing import MACHINES, METHODS, Swing, document

    p.add_argument("--case", type=_count, choices=tuple(MACHINES), required=True, help="the IEEE case")
    p.add_argument("--nodes", type=_count, metavar="N", help="observers, at most and by default one per machine")
    p.add_argument("--loads", type=_count, default=1, metavar="Q", help="loads that nobody meters (default 1)")
    expect = (
        "Needs the package PYPOWER: pip install 'duio_mesh[grid]'. --nodes times --loads should be at least the number "
        "of machines, 4 or 9. The design takes seconds; that of augmented for case 39 takes more than a minute."
    )
    _common(p, METHODS, "ring", expect)
    p.set_defaults(make=lambda a: document(Swing(a.case, a.nodes, a.loads, a.graph, a.method, a.seed)))


def _count(word: str) -> int:
    if not re.fullmatch(r"\d{1,9}", word):
        raise argparse.ArgumentTypeError(f"should be a whole number from 0, not {word!r}")
    return int(word)


def _rooms(word: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", word)
    if not found or "0" in (found[1].lstrip("0") or "0", found[2].lstrip("0") or "0"):
        raise argparse.ArgumentTypeError(f"should be rows x columns, each at least 1, like 8x8, not {word!r}")
    height, width = int(found[1]), int(found[2])
    if height * width > 2000:
        raise argparse.ArgumentTypeError(f"{height * width} rooms are too many; a plant has at most 2000 states")
    return height, width


def main(argv: Sequence[str]) -> int:
    """Write the file; the exit code. ``argv`` is what follows `new`."""
    args = parser().parse_args(argv)
    make: Callable[[argparse.Namespace], Document] = args.make
    try:
        written = _order(argv) + text(make(args))
        if args.out is None:
            sys.stdout.write(written)
            return WRITTEN
        _write(args.out, written)
    except ScenarioError as e:
        print(e, file=sys.stderr)
        return IMPOSSIBLE
    print(f"{args.out}: written; python launch.py {shlex.quote(str(args.out))} --check designs its gains")
    return WRITTEN


def _order(argv: Sequence[str]) -> str:
    """The comment that says how to make the file again; where it was written to does not belong to it."""
    words, skip = [], False
    for word in argv:
        if not skip and not word.startswith("--out="):
            words.append(word)
        skip = word == "--out"
    return f"# Made by: python launch.py new {shlex.join(w for w in words if w != '--out')}\n#\n"


def _write(path: Path, written: str) -> None:
    """A new file, with the schema's place in its first line when the schema stands beside it or one folder up."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ScenarioError([f"--out {path}: cannot be written: {e.strerror}"]) from None
    for schema in ("schema.json", "../schema.json"):
        if (path.parent / schema).is_file():
            written = f"# yaml-language-server: $schema={schema}\n{written}"
            break
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(written)
    except FileExistsError:
        raise ScenarioError([f"--out {path}: already exists; a file is never overwritten"]) from None
    except OSError as e:
        raise ScenarioError([f"--out {path}: cannot be written: {e.strerror}"]) from None
