"""Lockstep rounds per second on a ring: the project's mesh against the same exchange over bare transports.

    python bench/exchange.py [--nodes 4 8 16 32 64] [--rounds 8000] [--size 6] [--repeat 5] [--memory 4 16 64]

The rivals (rivals.py) share no code with the project. Its own rows: `admm` on a generated ring of N nodes, 199 rounds a
step, so that plant and journals do not count; and, for N = 4, the nine-room ring with one round a step, plant, journals
and recorder included. All of one N are interleaved in shuffled order. Absolute numbers of a shared machine mean little;
the ratios are within one run.
"""

from __future__ import annotations

import argparse
import statistics
from functools import partial
from typing import TYPE_CHECKING

import rivals
from interleave import Contenders, interleaved, machine, table
from processes import memories

if TYPE_CHECKING:
    from duio_mesh.launcher import Progress

REFERENCE = "bare Zenoh"
ROUNDS = 199  # exchanges per step of the project's ring
MPI_SHARE = 10  # MPI spins while it waits: with more processes than cores it gets a tenth of the rounds


def contenders(count: int, rounds: int, size: int) -> Contenders:
    """Everybody's measurement for a ring of ``count`` processes."""
    import rings  # not at the top: every process of a rival imports this module

    ring = rings.admm_ring(count, max(1, rounds // ROUNDS), {"nu": ROUNDS + 1})
    found = {
        REFERENCE: partial(rivals.bare_zenoh, count, rounds, size),
        "bare Zenoh, SCHED_BATCH": partial(rivals.bare_zenoh, count, rounds, size, True),
        "duio_mesh, admm": lambda: float(rings.run_mesh(ring)["rounds_per_second"]),
    }
    if count == 4:
        nine = rings.lmi_ring(rounds)
        found["duio_mesh, lmi, n = 9, recorded"] = lambda: float(rings.run_mesh(nine, record=True)["rounds_per_second"])
    return found | {
        "pyzmq PAIR, ipc": partial(rivals.zmq_pair, count, rounds, size),
        "multiprocessing.Pipe": partial(rivals.pipes, count, rounds, size),
        "mpi4py Neighbor_allgather": partial(rivals.mpi, count, max(1, rounds // MPI_SHARE), size),
    }


def node_memory(count: int) -> float:
    """PSS of a node process in MB while the ring runs, the median over its nodes."""
    import rings

    sizes: list[float] = []

    def look(progress: Progress) -> None:
        if sizes or not progress.steps:
            return
        sizes.extend(size.pss for who, size in memories().items() if who.startswith("node-"))

    rings.run_mesh(rings.admm_ring(count, 4000 // count, {"nu": 60}), show=look)
    if len(sizes) != count:
        raise SystemExit(f"{len(sizes)} node processes instead of {count} were seen")
    return statistics.median(sizes)


def main() -> None:
    """Interleave and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="*", default=[4, 8, 16, 32, 64])
    parser.add_argument("--rounds", type=int, default=8000, help="of a ring of four; N nodes do 4/N of them")
    parser.add_argument("--size", type=int, default=6, help="doubles a message of the bare exchanges")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--memory", type=int, nargs="*", default=[4, 16, 64], help="rings whose nodes' PSS is reported")
    args = parser.parse_args()
    print(f"{machine()}; {args.repeat} repetitions\n", flush=True)
    for count in args.nodes:
        found = interleaved(contenders(count, max(ROUNDS, args.rounds * 4 // count), args.size), args.repeat)
        print(table(f"ring of {count}", found, REFERENCE, "rounds/s"), flush=True)
    if args.memory:
        print("| nodes | PSS of a node, MB |\n|---|---|")
    for count in args.memory:
        print(f"| {count} | {node_memory(count):.1f} |", flush=True)


if __name__ == "__main__":
    main()
