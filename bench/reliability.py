"""What each observer makes of each kind of fault: the table of docs/reliability.md.

    python bench/reliability.py            print the table, from the oracle: two minutes of CPU time
    python bench/reliability.py --mesh     and run every cell as processes over Zenoh, too: it has to give the same bits
                                           (several minutes)
    python bench/reliability.py --write    put the table into docs/reliability.md
    python bench/reliability.py --only relaxed    only cases whose name has this in it

Ends with exit code 1 when an estimate is wrong and not flagged, or when the mesh does not equal the oracle. Same seeds,
same bits. The runs, the faults and how they are judged: bench/fault_cells.py.
"""

from __future__ import annotations

import argparse
import math
import sys
import time

from fault_cells import CASES, SEED, Cell, cells
from page import Page

KINDS = {  # of faults: what is said above their table
    "losses": "Lost frames",
    "delays": "Late frames",
    "frames": "Duplicates, reordering, corruption",
    "cuts": "Partition and heal",
    "processes": "Killed and stopped processes",
}


def verdict(cell: Cell) -> str:
    """In the tables."""
    return "**MESH DIFFERS**" if cell.same is False else cell.verdict


def overview(found: list[Cell]) -> str:
    """The verdicts alone: a row per case, a column per fault."""
    faults = list(dict.fromkeys(c.fault for c in found))
    said = {(c.case, c.fault): verdict(c) for c in found}
    lines = [f"| | {' | '.join(faults)} |", "|---" * (len(faults) + 1) + "|"]
    for case in dict.fromkeys(c.case for c in found):
        lines.append(f"| {case} | {' | '.join(said.get((case, fault), '') for fault in faults)} |")
    return "\n".join(lines)


def details(kind: str, found: list[Cell]) -> str:
    """A row per cell of one kind."""
    lines = [
        f"<details><summary>{KINDS[kind]}: {len(found)} cells</summary>",
        "",
        "| run | fault | error during it | at the end | without it | flagged | not flagged | steps to recover "
        "| trusted again | verdict | mesh = oracle |",
        "|---" * 11 + "|",
    ]
    for c in found:
        numbers = " | ".join("none" if math.isnan(e) else f"{e:.1e}" for e in (c.during, c.final, c.clean))
        trusted = "none" if math.isnan(c.trusted) else f"{c.trusted:.1e}"
        steps, doubted = ("never" if k is None else str(k) for k in (c.steps, c.doubted))
        same = {True: "yes", False: "**no**", None: "not run"}[c.same]
        lines.append(
            f"| {c.case} | {c.fault} | {numbers} | {100 * c.flagged:.0f} % | {trusted} | {steps} | {doubted} "
            f"| {verdict(c)} | {same} |"
        )
    return "\n".join([*lines, "", "</details>"])


def summary(found: list[Cell]) -> str:
    """The count."""
    ran = [c for c in found if c.same is not None]
    mesh = f"as processes over Zenoh {sum(bool(c.same) for c in ran)} of {len(ran)} gave the oracle's bits"
    verdicts = {name: sum(c.verdict == name for c in found) for name in ("right", "flagged")}
    silent = len(found) - sum(verdicts.values())
    return (
        f"Seed of the faults {SEED}; plant and noise as in the topology files (seed 0). {len(found)} cells: "
        f"{verdicts['right']} right, {verdicts['flagged']} flagged, {silent} silently wrong; "
        f"{mesh if ran else 'from the oracle alone'}."
    )


def main() -> int:
    """Run the cells, print the tables, write them if asked."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--mesh", action="store_true")
    p.add_argument("--write", action="store_true")
    p.add_argument("--only", default="")
    args = p.parse_args()
    if args.only and args.write:
        p.error("--write needs all cases")
    cases, begin, found = tuple(case for case in CASES if args.only in case.name), time.monotonic(), list[Cell]()
    for cell in cells(cases, args.mesh):
        found.append(cell)
        print(
            f"{time.monotonic() - begin:6.1f} s  {cell.case}; {cell.fault}: {verdict(cell)}",
            file=sys.stderr,
            flush=True,
        )
    page = Page("reliability.md", "table")
    page.say(summary(found))
    page.say()
    page.say(overview(found))
    for kind in KINDS:
        page.say()
        page.say(details(kind, [c for c in found if c.kind == kind]))
    if args.write:
        page.write()
    return int(any(c.same is False or "WRONG" in c.verdict for c in found))


if __name__ == "__main__":
    sys.exit(main())
