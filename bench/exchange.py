"""Lockstep rounds per second: the project's mesh against a bare Zenoh exchange of the same vectors, interleaved.

    python bench/exchange.py [--rounds 20000] [--repeat 5]

The bare exchange is written here without any of the project's code: N processes in a ring, tcp on loopback, one key per
directed edge, BLOCK, a FIFO channel per neighbour, one 8-byte header and the vector as bytes. Both runs use the same
Zenoh settings for links and threads. Absolute numbers of a shared machine mean little; the ratio is within one run.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import statistics
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ.setdefault(
    "ZENOH_RUNTIME", "(acc:(handover:app),rx:(handover:app),net:(handover:app),app:(worker_threads:1))"
)

SIZE = 9  # float64 a message, as in the nine-room building


def bare_node(i: int, count: int, ports: list[int], rounds: int, results: Any) -> None:
    """One process of the bare exchange."""
    import numpy as np
    import zenoh

    config = zenoh.Config()
    neighbours = sorted({(i - 1) % count, (i + 1) % count} - {i})
    settings = {
        "mode": "peer",
        "listen/endpoints": [f"tcp/127.0.0.1:{ports[i]}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{ports[j]}" for j in neighbours if j < i],
        "connect/retry": {"period_init_ms": 10, "period_max_ms": 100, "period_increase_factor": 1.5},
        "open/return_conditions/connect_scouted": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        heard = [session.declare_subscriber(f"e/{j}/{i}", zenoh.handlers.FifoChannel(64)) for j in neighbours]
        ready = [session.declare_subscriber(f"r/{j}/{i}") for j in neighbours]
        block = zenoh.CongestionControl.BLOCK
        told = [session.declare_publisher(f"e/{i}/{j}", congestion_control=block, express=False) for j in neighbours]
        barrier = [session.declare_publisher(f"r/{i}/{j}") for j in neighbours]
        matched = [publisher.declare_matching_listener() for publisher in barrier]
        for publisher, listener in zip(barrier, matched, strict=True):
            while not publisher.matching_status.matching:
                listener.recv()
        x, header = np.arange(float(SIZE)), struct.Struct("<Q")
        begin = time.perf_counter()
        for k in range(rounds):
            frame = header.pack(k) + x.tobytes()
            for publisher in told:
                publisher.put(frame)
            for subscriber in heard:
                data = subscriber.recv().payload.to_bytes()
                if header.unpack_from(data)[0] != k:
                    raise SystemExit(f"round {header.unpack_from(data)[0]} instead of {k}")
                np.frombuffer(data, offset=8)
        results.put((i, rounds / (time.perf_counter() - begin)))
        del ready


def bare(count: int, rounds: int) -> float:
    """Rounds per second of the bare exchange, the slowest node's."""
    held = [socket.socket() for _ in range(count)]
    for s in held:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        s.bind(("127.0.0.1", 0))
    ports = [s.getsockname()[1] for s in held]
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    nodes = [context.Process(target=bare_node, args=(i, count, ports, rounds, results)) for i in range(count)]
    for node in nodes:
        node.start()
    speeds = [results.get(timeout=300)[1] for _ in nodes]
    for node in nodes:
        node.join()
    for s in held:
        s.close()
    return min(speeds)


def mesh(topology: Path, rounds: int, overrides: dict[str, Any]) -> float:
    """Rounds per second of the project: plant, nodes, journals and recorder and all."""
    import duio_mesh

    scenario = duio_mesh.load_scenario(topology, **overrides, **{"run.steps": rounds})
    design = duio_mesh.synthesise(scenario)
    with tempfile.TemporaryDirectory() as out:
        return float(duio_mesh.run(design, Path(out) / "run", record=True).metrics["rounds_per_second"])


def main() -> None:
    """Interleave and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20_000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    ring = Path(__file__).parent.parent / "topologies" / "ring.yaml"
    table = []
    for repetition in range(args.repeat):
        table.append((bare(4, args.rounds), mesh(ring, args.rounds, {})))
        b, m = table[-1]
        print(f"{repetition + 1}: bare {b:8.0f} rounds/s   mesh {m:8.0f} rounds/s   ratio {m / b:.2f}", flush=True)
    ratios = [m / b for b, m in table]
    print(f"ratio: median {statistics.median(ratios):.2f}, {min(ratios):.2f} to {max(ratios):.2f}", file=sys.stdout)


if __name__ == "__main__":
    main()
