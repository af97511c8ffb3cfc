"""Seconds of wall clock per simulated step of the ADMM observer: mesh against oracle, one step at a time and batched.

    python bench/admm.py [--steps 320] [--repeat 3]

The ring of four of topologies/admm_ring.yaml: 59 exchanges a step with nu = 60, two with finite_time; batched
(run.batch), W steps share their two exchanges. The oracle's row is one process without any messages.
"""

from __future__ import annotations

import argparse
import time
from functools import partial

import rings
from interleave import Contenders, interleaved, machine, table

import duio_mesh
from duio_mesh.synthesis.design import Design

ADMM, FINITE = {"nu": 60}, {"fusion": "finite_time"}
LONGER = 10  # times as many steps with finite_time, which has far fewer exchanges


def mesh_milliseconds(design: Design) -> float:
    """Per step over Zenoh, without the start of the processes; no recorder."""
    metrics = rings.run_mesh(design)
    return 1e3 * metrics["rounds"] / metrics["rounds_per_second"] / design.plant.steps


def oracle_milliseconds(design: Design) -> float:
    """Per step in one process."""
    begin = time.perf_counter()
    duio_mesh.simulate(design)
    return 1e3 * (time.perf_counter() - begin) / design.plant.steps


def contenders(steps: int) -> Contenders:
    """Both drivers for every kind of run."""
    designs = {"admm, nu = 60": rings.admm_ring(4, steps, ADMM)}
    for batch in (1, 7, 64):
        designs[f"finite_time, batch {batch}"] = rings.admm_ring(4, LONGER * steps, FINITE, batch=batch)
    found = {}
    for name, design in designs.items():
        found[f"{name}: mesh"] = partial(mesh_milliseconds, design)
        found[f"{name}: oracle"] = partial(oracle_milliseconds, design)
    return found


def main() -> None:
    """Interleave and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=320, help="with nu = 60; ten times as many with finite_time")
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
    print(f"{machine()}; {args.repeat} repetitions\n", flush=True)
    found = interleaved(contenders(args.steps), args.repeat)
    print(table("four nodes", found, "admm, nu = 60: mesh", "ms per step", "{:.3f}"))


if __name__ == "__main__":
    main()
