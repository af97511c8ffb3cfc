"""Many sensor processes on one machine: rounds, start, memory, and the oracle's estimates, for rings of N nodes.

    python bench/scale.py [--nodes 16 64 128] [--rounds 60000] [--repeat 5] [--record 64] [--write]

The ring of bench/rings.py, `admm` with 199 rounds a step; N nodes do 4/N of the rounds, so that every run takes about
as long. All N take turns in shuffled order. The speed is compared as rounds per second times N: on the same cores a
ring of N has N/4 times the work of a ring of four in every round. The start is from the end of the design to the last
node's `ready`, with a nursery that came up while the gains were designed, as on the command line. `pinned`: each part
of the ring stays on one core from the first step on.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import rings
from interleave import Contenders, Results, interleaved, machine, table
from page import Page
from processes import family, memories

from duio_mesh import launcher
from duio_mesh.launcher import Progress
from duio_mesh.supervisor import Supervisor

ROUNDS = 199  # exchanges per step
REFERENCE = "4 nodes"


class Run(NamedTuple):
    """One run of a ring."""

    speed: float  # rounds per second
    start: float  # seconds from the design's end to the last node's ready
    memory: float  # PSS in MB of the largest node, or NaN where there was no time to look
    same: bool  # as the oracle


def ready(logs: Path) -> float:
    """When the last node was ready."""
    events = [json.loads(line) for path in logs.glob("node-*.jsonl") for line in path.read_text().splitlines()]
    return max(float(event["time"]) for event in events if event["event"] == "ready")


def pin(count: int) -> None:
    """Let all threads of every node stay on the core of its part of the ring."""
    cores = sorted(os.sched_getaffinity(0))
    for who, pid in family().items():
        if who.startswith("node-"):
            core = cores[(int(who.removeprefix("node-")) - 1) * len(cores) // count]
            for thread in Path(f"/proc/{pid}/task").iterdir():
                os.sched_setaffinity(int(thread.name), {core})


def measure(count: int, steps: int, kind: str, runs: dict[str, list[Run]], name: str) -> float:
    """Rounds per second of one run, times N; the rest is added to ``runs``. ``kind``: recorded, pinned, or ""."""
    record = kind == "recorded"
    sizes: list[float] = []

    def look(progress: Progress) -> None:
        if progress.steps and not sizes:
            sizes.extend(size.pss for who, size in memories().items() if who.startswith("node-"))
            if kind == "pinned":
                pin(count)

    with tempfile.TemporaryDirectory() as out, Supervisor() as supervisor:
        if record:
            supervisor.prepare("recorder")
        design = rings.admm_ring(count, steps, {"nu": ROUNDS + 1})
        begin, folder = time.time(), Path(out) / "run"
        result = launcher.run(design, folder, record=record, show=look, supervisor=supervisor)
        start = ready(folder / "logs") - begin
        oracle = launcher.run_in_process(design, Path(out) / "oracle", record=False)
    same = result.metrics["estimates_sha256"] == oracle.metrics["estimates_sha256"]
    speed = float(result.metrics["rounds_per_second"])
    runs.setdefault(name, []).append(Run(speed, start, max(sizes, default=float("nan")), same))
    return speed * count


def contenders(counts: dict[str, list[int]], rounds: int, runs: dict[str, list[Run]]) -> Contenders:
    """A measurement for every kind and N."""
    found: dict[str, Callable[[], float]] = {}
    for kind, many in counts.items():
        for count in many:
            name = f"{count} nodes" + (f", {kind}" if kind else "")
            steps = max(3, round(4 * rounds / count / ROUNDS))
            found[name] = partial(measure, count, steps, kind, runs, name)
    return found


def main() -> None:
    """Interleave and print the tables; ends with 1 where a run differs from the oracle."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="*", default=[16, 64, 128], help="beside the ring of 4")
    parser.add_argument("--rounds", type=int, default=60_000, help="of the ring of four; N nodes do 4/N of them")
    parser.add_argument("--record", type=int, nargs="*", default=[64], help="rings that are run with a recorder, too")
    parser.add_argument(
        "--pinned", type=int, nargs="*", default=[64], help="rings that are cut into parts, a core for each"
    )
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/scaling.md")
    args = parser.parse_args()
    page = Page("scaling.md", "rings")
    page.say(f"{machine()}; {args.repeat} repetitions\n")
    runs: dict[str, list[Run]] = {}
    counts = {"": [4, *args.nodes], "recorded": args.record, "pinned": args.pinned}
    results: Results = interleaved(contenders(counts, args.rounds, runs), args.repeat)
    page.say(table("ring", results, REFERENCE, "rounds/s times N"))
    page.say("| ring | rounds/s | ready after, s | PSS of the largest node, MB | the oracle's estimates |")
    page.say("|---|---|---|---|---|")
    for name, of in ((name, runs[name]) for name in results):
        middle = [statistics.median(run[at] for run in of) for at in range(3)]
        same = "yes" if all(run.same for run in of) else "NO"
        page.say(f"| {name} | {middle[0]:.0f} | {middle[1]:.2f} | {middle[2]:.1f} | {same} |")
    if args.write:
        page.write()
    sys.exit(0 if all(run.same for of in runs.values() for run in of) else 1)


if __name__ == "__main__":
    main()
