"""Random kills and freezes of random nodes in runs with `on_node_loss: restart`: do they finish, and right?

    python bench/losses.py --kills 100 --freezes 20 --seed 1
    python bench/losses.py --kills 10 --freezes 2    a first look
    python bench/losses.py --write                   and put the result into docs/reliability.md

Every run is started from the command line, as a user would. A node is chosen, and a moment: as soon as its process
exists, or when it has written a random part of its rows. Then it gets SIGKILL, or SIGSTOP and 2 s later SIGCONT. Asked
is: exit code 0 (converged), no process left, and, after a kill, that the node was back in step or the run was over
before that was possible; after a freeze, the same bits as without it.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
from page import Page

ROOT = Path(__file__).parent.parent
# ADMM forgets a start from its neighbours' marked estimates with 0.988 a step: errors are 1e-3 for a while
RUNS = {  # topology -> what to change, so that a run lasts a second or two; floats in a row, the flag included
    "ring.yaml": (10, {"run.steps": 6000}),
    "six_state_ring.yaml": (7, {"run.steps": 4000, "run.convergence.rms_below": 10}),
    "partitioned.yaml": (10, {"run.steps": 4000}),
    "augmented_heat_ring.yaml": (10, {"run.steps": 4000}),
    "admm_ring.yaml": (7, {"run.steps": 150, "run.convergence.rms_below": 0.01}),
    "relaxed_ring.yaml": (7, {"run.steps": 150, "run.convergence.rms_below": 0.01}),
    "geometric_ring.yaml": (7, {"run.steps": 4000}),
    "reduced_order_kundur8.yaml": (9, {"run.steps": 2000}),
}
ALL = {"run.on_node_loss": "restart", "run.convergence.over_last": 0.05}
FREEZE = 2.0  # seconds
LAST = 0.8  # of its steps: no later, so that errors can be small again in the last 5 %, which are judged
LIMIT = 120.0  # seconds that a run may take


class Case:
    """One run and what is done to it."""

    def __init__(self, topology: str, node: int, part: float | None, freeze: bool) -> None:
        self.topology, self.node, self.part, self.freeze = topology, node, part, freeze
        self.row, self.changes = RUNS[topology]

    def __str__(self) -> str:
        when = "at its start" if self.part is None else f"after {self.part:.0%} of its steps"
        return f"{self.topology}: {'freeze' if self.freeze else 'kill'} node-{self.node} {when}"

    def run(self, out: Path) -> str:
        """'' when all is well, else what is not."""
        sets = [f"--set={path}={value}" for path, value in (self.changes | ALL).items()]
        command = [sys.executable, str(ROOT / "launch.py"), str(ROOT / "topologies" / self.topology), "--no-record"]
        process = subprocess.Popen(
            [*command, *sets, "--out", str(out)],
            cwd=out.parent,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        family, here = psutil.Process(process.pid), str(out.parent)
        threading.Thread(target=self._strike, args=(family, out), daemon=True).start()
        try:
            said, _ = process.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            process.kill()
            return "took too long"
        if process.returncode not in ((0, 1) if os.environ.get("LAX") else (0,)):
            return f"exit code {process.returncode}: {said.strip().splitlines()[-1]}"
        left = [
            p.name() for p in psutil.process_iter(["cwd"]) if p.name().startswith("duio-") and p.info["cwd"] == here
        ]
        if left:
            return f"left behind: {left}"
        return self._judge(json.loads((out / "metrics.json").read_text()))

    def _judge(self, metrics: dict[str, Any]) -> str:
        happened = Counter(event["event"] for event in metrics["events"])
        late = any("before it was back" in w or "went on without" in w for w in metrics.get("warnings", ()))
        if not self.freeze and happened["death"] and not happened["back"] and not late:
            return f"killed, and not back: {dict(happened)}"
        return ""

    def _strike(self, family: psutil.Process, out: Path) -> None:
        """Wait for the moment, then send the signal."""
        rows = out / "rows" / f"node-{self.node}.f64"
        wanted = 8 * self.row * (self.part or 0.0) * self.changes["run.steps"]
        end = time.monotonic() + LIMIT
        tick = threading.Event()
        while time.monotonic() < end and not tick.wait(0.002):
            try:
                victims = [p for p in family.children(recursive=True) if p.name() == f"duio-node-{self.node}"]
                there = self.part is None or (rows.exists() and rows.stat().st_size >= wanted)
                if victims and there:
                    victims[0].send_signal(signal.SIGSTOP if self.freeze else signal.SIGKILL)
                    if self.freeze:
                        tick.wait(FREEZE)
                        victims[0].send_signal(signal.SIGCONT)
                    return
            except (psutil.NoSuchProcess, FileNotFoundError):
                if not family.is_running():
                    return


def cases(kills: int, freezes: int, seed: int) -> list[Case]:
    """The cases of a seed."""
    draw = random.Random(seed)
    found = []
    for number in range(kills + freezes):
        topology = draw.choice(sorted(RUNS))
        part = draw.choice([None, *(draw.uniform(0, LAST) for _ in range(9))])
        found.append(Case(topology, draw.choice((1, 2, 3)), part, number >= kills))
    return found


def main() -> int:
    """Run all cases; 0 when all is well."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--kills", type=int, default=100)
    p.add_argument("--freezes", type=int, default=20)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--write", action="store_true")
    args = p.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    good: Counter[str] = Counter()
    bad = list[Case]()
    with tempfile.TemporaryDirectory() as folder:
        for number, case in enumerate(cases(args.kills, args.freezes, args.seed)):
            problem = case.run(Path(folder) / str(number))
            good["freeze" if case.freeze else "kill"] += not problem
            print(f"{number + 1:4} {case}: {problem or 'ok'}", flush=True)
            bad += [case] if problem else []
    kills, freezes = f"{good['kill']} of {args.kills} kills", f"{good['freeze']} of {args.freezes} freezes"
    page = Page("reliability.md", "losses")
    page.say(f"Seed {args.seed}: {kills} and {freezes} survived.")
    if bad:
        page.say("\n".join(["Not:", "", *(f"- {case}" for case in bad)]))
    if args.write:
        page.write()
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
