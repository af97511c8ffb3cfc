"""What each observer makes of faults, in the oracle: the table of docs/reliability.md.

    python bench/reliability.py            print the table
    python bench/reliability.py --write    and put it into docs/reliability.md

Ends with exit code 1 when an estimate is wrong and not flagged. Same seeds, same bits; takes a minute of CPU time.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.simulation import Trace

ROOT = Path(__file__).parent.parent
PAGE, BEGIN, END = ROOT / "docs" / "reliability.md", "<!-- table -->\n", "<!-- end of table -->\n"
SEED = 2026  # of the faults; plant and noise keep the topology's own seed

RUNS: list[tuple[str, str, dict[str, Any]]] = [  # what to call it, topology, changes
    ("lmi, ring", "ring", {}),
    ("lmi, star", "star", {}),
    ("lmi, two islands", "partitioned", {}),
    ("lmi, unstable plant, ring", "six_state_ring", {"plant.noise": 0, "run.convergence.rms_below": 0.1}),
    ("lmi, the same, hold", "six_state_ring",
     {"plant.noise": 0, "run.convergence.rms_below": 0.1, "observer.without": "hold"}),
    ("augmented, path", "augmented_example9", {}),
    ("augmented, ring", "augmented_six_state", {}),
    ("admm, ring", "admm_ring", {"run.steps": 60}),
    ("admm finite_time, ring", "finite_time_ring", {"run.steps": 300, "observer.setup": "global"}),
    ("admm relaxed, ring", "relaxed_ring", {"run.steps": 60}),
    ("geometric, ring", "geometric_ring", {}),
    ("geometric, ring, pair", "geometric_ring", {"observer.without": "pair"}),
    ("reduced_order, ring", "reduced_order_kundur8", {}),
    ("reduced_order, ring, pair", "reduced_order_kundur8", {"observer.without": "pair"}),
]  # fmt: skip
LINKS: dict[str, dict[str, Any]] = {
    "loss 1 %": {"loss": 0.01},
    "loss 5 %": {"loss": 0.05},
    "loss 20 %": {"loss": 0.2},
    "bursts": {"gilbert_elliott": {"worsen": 0.01, "mend": 0.25}},
    "half of them 1 step late": {"delay": {"steps": [0, 1]}},
    "delay 1 step": {"delay": {"steps": 1}},
    "delay 3 steps": {"delay": {"steps": 3}},
    "duplicates 20 %": {"duplicate": 0.2},
    "reordering 5 %": {"reorder": 0.05},
    "corruption 1 %": {"corrupt": 0.01},
}


class Cell(NamedTuple):
    """One run: RMS errors per component of the state over the last part of the run that the verdict looks at."""

    run: str
    fault: str
    rms: float  # of the worst node
    clean: float  # the same without faults
    flagged: float  # share of all estimates
    trusted: float  # RMS of the worst node over its estimates that are not flagged; NaN when there are none
    recovery: int | None  # steps after a cut until every error stays below twice the worst of the fault-free run
    verdict: str


def errors(trace: Trace) -> Any:
    """(N, K): RMS over the components of the state."""
    return np.sqrt(np.mean((trace.xhat - trace.x) ** 2, axis=2))


def cells() -> Iterator[Cell]:
    """Every run under every fault."""
    for name, topology, changes in RUNS:
        path = ROOT / "topologies" / f"{topology}.yaml"
        scenario = load_scenario(path, **changes)
        steps, arcs = scenario.run.steps, scenario.graph.arcs
        clean = errors(simulate(synthesise(scenario)))
        hub = max(scenario.graph.ids, key=lambda i: len(scenario.graph.hears(i)))
        during = [steps // 4, steps // 2]
        faults: dict[str, dict[str, Any]] = {fault: {"links": [link]} for fault, link in LINKS.items()}
        one = [[arcs[0].source, arcs[0].target]]
        alone = [[hub, j] for j in scenario.graph.hears(hub)]
        faults["one edge cut, healed"] = {"cuts": [{"edges": one, "during": during}]}
        faults["one node cut off, healed"] = {"cuts": [{"edges": alone, "during": during}]}
        for fault, entry in faults.items():
            trace = simulate(synthesise(load_scenario(path, **changes, faults=entry | {"seed": SEED})))
            healed = during[1] if "cuts" in entry else None
            yield judged(name, fault, trace, clean, scenario.run.convergence, healed)


def judged(name: str, fault: str, trace: Trace, clean: Any, wanted: Any, healed: int | None) -> Cell:
    """right: converged as the topology asks. flagged: not so, but the estimates without a flag are. Else WRONG."""
    e, flags = errors(trace), trace.flagged
    assert flags is not None
    last = slice(-round(e.shape[1] * wanted.over_last), None)
    rms = float(np.sqrt(np.mean(e[:, last] ** 2, axis=1)).max())
    kept = [np.sqrt(np.mean(row[~f] ** 2)) for row, f in zip(e[:, last], flags[:, last], strict=True) if not f.all()]
    trusted = float(max(kept, default=np.nan))
    recovery = None
    if healed is not None:
        bad = np.nonzero((e[:, healed:] > 2 * clean[:, last].max()).any(axis=0))[0]
        recovery = int(bad[-1]) + 1 if len(bad) else 0
    wrong = not (np.isnan(trusted) or trusted < wanted.rms_below)
    verdict = "right" if rms < wanted.rms_below else "**WRONG**" if wrong else "flagged"
    ideal = float(np.sqrt(np.mean(clean[:, last] ** 2, axis=1)).max())
    return Cell(name, fault, rms, ideal, float(flags.mean()), trusted, recovery, verdict)


def table(found: list[Cell]) -> str:
    """In Markdown."""
    lines = [
        f"Seed of the faults {SEED}; plant and noise as in the topology files (seed 0).",
        "",
        "| run | fault | RMS | without faults | flagged | RMS not flagged | steps to recover | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for c in found:
        trusted = "none" if np.isnan(c.trusted) else f"{c.trusted:.1e}"
        recovery = "" if c.recovery is None else str(c.recovery)
        lines.append(
            f"| {c.run} | {c.fault} | {c.rms:.1e} | {c.clean:.1e} | {100 * c.flagged:.0f} % | {trusted} | {recovery} "
            f"| {c.verdict} |"
        )
    return "\n".join(lines) + "\n"


def main(argv: list[str]) -> int:
    """Print the table, write it if asked."""
    found = list(cells())
    text = table(found)
    sys.stdout.write(text)
    if "--write" in argv:
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(before + BEGIN + text + END + rest.split(END)[1], encoding="utf-8")
    return int(any("WRONG" in c.verdict for c in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
