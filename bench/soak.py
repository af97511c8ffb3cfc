"""A long run: does any process grow, is any frame lost, and are the estimates still the oracle's, bit for bit?

    python bench/soak.py [--rounds 1000000] [--nodes 4] [--batch 1] [--no-record] [--write]

The ring of topologies/admm_ring.yaml with `finite_time`: two rounds a step on a ring of four, so that plant, samples,
credits, journals and recorder work as hard as the exchange between the nodes. The memory of every process (launcher
and nursery included) is read 200 times at equal steps of progress; of each, the median of the last tenth of the run is
compared with that of the second tenth. (RSS and anonymous memory have to be flat; PSS changes with what else on the
machine has the same libraries open, and is shown.) Ends with 1 where something grew, was lost, or differs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rings
from interleave import machine
from page import Page
from processes import Memory, memories

from duio_mesh import launcher
from duio_mesh.launcher import Progress
from duio_mesh.supervisor import Supervisor
from duio_mesh.synthesis.design import Design

SAMPLES = 200
GROWTH = 0.02  # of memory that counts as flat
TENTHS = ((0.1, 0.2), (0.9, 1.0))  # of the run that are compared
NOT_SEEN = Memory(*[float("nan")] * len(Memory._fields))


class Samples:
    """The memory of every process at equal steps of progress, in an array that is there from the beginning."""

    def __init__(self, steps: int, nodes: Iterable[int], record: bool) -> None:
        recorder = ["recorder"] if record else []
        self.who = ["launcher", *(f"node-{i}" for i in nodes), "nursery", "plant", *recorder]
        self._steps, self._due, self._count = steps, 0, 0
        self._at = np.full(SAMPLES + 1, np.nan)  # part of the run
        self._sizes = np.full((SAMPLES + 1, len(self.who), len(Memory._fields)), np.nan)

    def __call__(self, now: Progress) -> None:
        """Called by the launcher ten times a second."""
        if self._due <= now.steps < self._steps:
            self._due = now.steps + self._steps // SAMPLES
            found = memories()
            self._at[self._count] = now.steps / self._steps
            for row, who in zip(self._sizes[self._count], self.who, strict=True):
                row[:] = found.get(who, NOT_SEEN)
            self._count += 1

    def within(self, who: str, first: float, last: float) -> Memory:
        """The medians over a part of the run. Raises SystemExit where it was never looked at."""
        sizes = self._sizes[(self._at >= first) & (self._at < last), self.who.index(who)]
        seen = sizes[~np.isnan(sizes[:, 0])]
        if not len(seen):
            raise SystemExit(f"{who} was never looked at between {first:.0%} and {last:.0%} of the run: more --rounds")
        return Memory(*np.median(seen, axis=0).tolist())


def growths(page: Page, samples: Samples) -> list[str]:
    """Print the table; who grew by more than ``GROWTH``."""
    page.say(
        "| process | RSS, MB | last tenth | change | anonymous | last tenth | change | PSS | last tenth | change |"
    )
    page.say("|---|---|---|---|---|---|---|---|---|---|")
    grown = []
    for who in samples.who:
        early, late = (samples.within(who, *tenth) for tenth in TENTHS)
        cells = []
        for kind, before, after in zip(Memory._fields, early, late, strict=True):
            change = after / before - 1
            cells += [f"{before:.2f}", f"{after:.2f}", f"{change:+.2%}"]
            if kind != "pss" and abs(change) > GROWTH:
                grown.append(f"{kind} memory of {who} changed by {change:+.2%}")
        page.say(f"| {who} | {' | '.join(cells)} |")
    return grown


def losses(design: Design, metrics: Mapping[str, Any], done: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Frames that were not sent, and frames that were refused."""
    wrong = [f"{who} refused frames: {counts}" for who, counts in metrics["rejected"].items()]
    rounds = metrics["rounds"]
    for i, spec in design.nodes.items():
        said = done[f"node-{i}"]
        if said["frames"] != said["rounds"] * len(spec.tells) or said["rounds"] != rounds:
            wrong.append(f"node {i} sent {said['frames']} frames in {said['rounds']} of {rounds} rounds")
    blocks = -(-design.plant.steps // design.plant.block) * len(design.nodes)
    if done["plant"]["frames"] != blocks:
        wrong.append(f"the plant sent {done['plant']['frames']} frames instead of {blocks}")
    return wrong


def main() -> None:
    """Run, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=1_000_000)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--batch", type=int, default=1, help="steps that share an exchange")
    parser.add_argument("--no-record", action="store_true", help="without a recorder")
    parser.add_argument("--write", action="store_true", help="put the table into docs/scaling.md")
    args = parser.parse_args()
    per_step = rings.rounds_per_step(args.nodes)
    steps = -(-args.rounds // per_step) * args.batch
    design = rings.admm_ring(args.nodes, steps, {"fusion": "finite_time"}, batch=args.batch)
    page = Page("scaling.md", "soak")
    page.say(f"{machine()}\n")
    samples, begin = Samples(steps, design.nodes, not args.no_record), time.monotonic()
    with tempfile.TemporaryDirectory() as out, Supervisor() as supervisor:
        result = launcher.run(design, Path(out) / "run", record=not args.no_record, show=samples, supervisor=supervisor)
        done = {who: process.done for who, process in supervisor.processes.items()}
    metrics = result.metrics
    page.say(
        f"{metrics['rounds']} rounds, {steps} steps, {args.nodes} nodes; {metrics['messages']} frames between nodes;"
    )
    page.say(f"{metrics['rounds_per_second']:.0f} rounds/s, {time.monotonic() - begin:.0f} s in all\n")
    wrong = growths(page, samples) + losses(design, metrics, done) + list(result.warnings)
    if metrics["rounds"] < args.rounds:
        wrong.append(f"only {metrics['rounds']} rounds")
    del result
    with tempfile.TemporaryDirectory() as out:
        oracle = launcher.run_in_process(design, Path(out) / "run", record=False).metrics["estimates_sha256"]
    if oracle != metrics["estimates_sha256"]:
        wrong.append(f"the estimates differ from the oracle's: {metrics['estimates_sha256']} and {oracle}")
    page.say(f"\nestimates_sha256 {metrics['estimates_sha256']}, the oracle's {oracle}")
    page.say("\n".join(wrong) or "no process grew, no frame was lost, the oracle's estimates")
    if args.write:
        page.write()
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
