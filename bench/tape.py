"""What the tape of a node's inputs costs: rounds per second with and without, processor time, bytes; replay's speed.

    python bench/tape.py [--steps 3000] [--repeat 5]

Two rings of four without a recorder: lmi (ring.yaml: a sample, a round and an estimate per step) and admm (59 rounds a
step). The processor time is that of one observer that is given the same vectors again and again, in this process.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from interleave import interleaved, machine, table

import duio_mesh
from duio_mesh.observers import make_observer
from duio_mesh.observers.base import reader
from duio_mesh.replay.player import play
from duio_mesh.spec import NodeSpec, read_spec
from duio_mesh.synthesis.design import Design
from duio_mesh.tape import Tape, read_tape

HOME = Path(__file__).parent.parent


def design_of(name: str, steps: int, *, inputs: bool, **changes: object) -> Design:
    """A topology of this repository."""
    options = {"run.steps": steps, "run.inputs": inputs, **changes}
    return duio_mesh.synthesise(duio_mesh.load_scenario(HOME / "topologies" / f"{name}.yaml", **options))


def rounds_per_second(design: Design, played: list[float]) -> float:
    """One run over Zenoh; the speed of a replay goes to ``played``."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        metrics = duio_mesh.run(design, out, record=False).metrics
        if design.scenario.run.inputs:
            spec = read_spec(out / "nodes" / "node-1.spec", NodeSpec)
            begin = time.perf_counter()
            rounds = sum(block.exchanged for block in play(spec, read_tape(Path(spec.inputs))))
            played.append(rounds / (time.perf_counter() - begin))
    return float(metrics["rounds_per_second"])


def microseconds_per_round(spec: NodeSpec) -> tuple[float, float]:
    """(processor time of this thread, bytes of tape) per round of one observer alone."""
    y, u, rounds = np.ones(spec.p), np.ones(spec.m), 0
    with Tape(spec) as tape:
        observer = tape.follow(make_observer(spec))
        read, begin = reader(observer), time.thread_time()
        for _ in range(spec.steps):
            observer.sample(y, u)
            for r in range(observer.rounds):
                received = dict.fromkeys(sorted(spec.hears), observer.message(r).copy())
                observer.exchange(r, received)
                rounds += 1
            read()
        took = time.thread_time() - begin
    return 1e6 * took / rounds, (Path(spec.inputs).stat().st_size if spec.inputs else 0) / rounds


def measure(title: str, make: Callable[..., Design], repeat: int) -> None:
    """Both ways, interleaved; print the table and a line of figures."""
    played: list[float] = []
    contenders = {
        name: partial(rounds_per_second, make(inputs=inputs), played)
        for name, inputs in (("without", False), ("with tapes", True))
    }
    print(table(title, interleaved(contenders, repeat), "without", "rounds/s"))
    spec = make(inputs=True).nodes[1]
    more, size = [], 0.0
    for _ in range(repeat):
        with tempfile.TemporaryDirectory() as folder:
            plain, _ = microseconds_per_round(spec)
            noted, size = microseconds_per_round(replace(spec, inputs=str(Path(folder) / "node-1.tape")))
        more.append(noted - plain)
    print(
        f"the tape takes {statistics.median(more):.1f} us of processor time [{min(more):.1f} - {max(more):.1f}] and "
        f"{size:.0f} bytes per round; replay {statistics.median(played):,.0f} rounds/s\n",
        flush=True,
    )


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    print(f"{machine()}; {args.repeat} repetitions, {args.steps} steps\n", flush=True)
    measure("lmi, n = 9, four nodes", partial(design_of, "ring", args.steps), args.repeat)
    few = max(1, args.steps // 50)
    admm = partial(design_of, "admm_ring", few, **{"observer.nu": 60})
    measure("admm, n = 6, four nodes, 59 rounds a step", admm, args.repeat)


if __name__ == "__main__":
    main()
