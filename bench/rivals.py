"""The lockstep ring exchange without any of the project's code, over four transports.

N processes in a ring; in every round each sends one vector of doubles behind an 8-byte round number to both neighbours
and takes exactly that round's vector from both. All functions return the rounds per second of the slowest process.
"""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from queue import Empty
from typing import Any

from interleave import Missing

os.environ.setdefault(
    "ZENOH_RUNTIME", "(acc:(handover:app),rx:(handover:app),net:(handover:app),app:(worker_threads:1))"
)
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

HEADER = struct.Struct("<Q")
PATIENCE = 120.0  # seconds for one measurement

Send = Callable[[bytes], Any]
Receive = Callable[[], bytes]


def neighbours(i: int, count: int) -> list[int]:
    """Ids of the two neighbours on the ring, or of the one when there are two processes."""
    return sorted({(i - 1) % count, (i + 1) % count} - {i})


def lockstep(rounds: int, size: int, tell: Sequence[Send], hear: Sequence[Receive]) -> float:
    """The rounds per second of one process."""
    import numpy as np

    x = np.arange(float(size))
    begin = time.perf_counter()
    for k in range(rounds):
        frame = HEADER.pack(k) + x.tobytes()
        for send in tell:
            send(frame)
        for receive in hear:
            data = receive()
            if HEADER.unpack_from(data)[0] != k:
                raise SystemExit(f"round {HEADER.unpack_from(data)[0]} instead of {k}")
            np.frombuffer(data, offset=8)
    return rounds / (time.perf_counter() - begin)


def slowest(count: int, node: Callable[..., None], arguments: Callable[[int], tuple[Any, ...]]) -> float:
    """Run ``node(i, *arguments(i), results)`` in ``count`` processes; the least of what they put into ``results``."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    nodes = [context.Process(target=node, args=(i, *arguments(i), results)) for i in range(count)]
    for process in nodes:
        process.start()
    try:
        return min(float(results.get(timeout=PATIENCE)) for _ in nodes)
    except Empty:
        raise Missing(f"not done after {PATIENCE:g} s") from None
    finally:
        for process in nodes:
            process.join(5)
            if process.is_alive():
                process.kill()


# -- Zenoh -----------------------------------------------------------------------------------------------


def zenoh_node(i: int, count: int, ports: list[int], rounds: int, size: int, batch: bool, results: Any) -> None:
    """tcp on loopback along the ring, one key per directed edge, BLOCK, a FIFO channel per neighbour."""
    import zenoh

    if batch:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    config, near = zenoh.Config(), neighbours(i, count)
    settings = {
        "mode": "peer",
        "listen/endpoints": [f"tcp/127.0.0.1:{ports[i]}"],
        "connect/endpoints": [f"tcp/127.0.0.1:{ports[j]}" for j in near if j < i],
        "connect/retry": {"period_init_ms": 10, "period_max_ms": 100, "period_increase_factor": 1.5},
        "open/return_conditions/connect_scouted": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        heard = [session.declare_subscriber(f"e/{j}/{i}", zenoh.handlers.FifoChannel(64)) for j in near]
        ready = [session.declare_subscriber(f"r/{j}/{i}") for j in near]
        block = zenoh.CongestionControl.BLOCK
        told = [session.declare_publisher(f"e/{i}/{j}", congestion_control=block, express=False) for j in near]
        barrier = [session.declare_publisher(f"r/{i}/{j}") for j in near]
        matched = [publisher.declare_matching_listener() for publisher in barrier]
        for publisher, listener in zip(barrier, matched, strict=True):
            while not publisher.matching_status.matching:
                listener.recv()

        def receiver(subscriber: Any) -> Receive:
            take = subscriber.handler.recv
            return lambda: bytes(take().payload.to_bytes())

        results.put(lockstep(rounds, size, [p.put for p in told], [receiver(s) for s in heard]))
        del ready


def bare_zenoh(count: int, rounds: int, size: int, batch: bool = False) -> float:
    """Zenoh with the mesh's settings for links and threads, and nothing on top; ``batch``: scheduled like the mesh."""
    with ExitStack() as held:
        sockets = [held.enter_context(socket.socket()) for _ in range(count)]
        for s in sockets:
            s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            s.bind(("127.0.0.1", 0))
        ports = [s.getsockname()[1] for s in sockets]
        return slowest(count, zenoh_node, lambda i: (count, ports, rounds, size, batch))


# -- ZeroMQ ----------------------------------------------------------------------------------------------


def zmq_node(i: int, count: int, folder: str, rounds: int, size: int, results: Any) -> None:
    """One PAIR socket per edge; the smaller id binds."""
    import zmq

    sockets = []
    with zmq.Context() as context:
        for j in neighbours(i, count):
            pair, path = context.socket(zmq.PAIR), f"ipc://{folder}/{min(i, j)}-{max(i, j)}"
            (pair.bind if i < j else pair.connect)(path)
            sockets.append(pair)
        for pair in sockets:  # everybody is there before the clock runs
            pair.send(b"")
        for pair in sockets:
            pair.recv()
        results.put(lockstep(rounds, size, [s.send for s in sockets], [s.recv for s in sockets]))
        for pair in sockets:
            pair.close(linger=1000)


def zmq_pair(count: int, rounds: int, size: int) -> float:
    """pyzmq, PAIR sockets over ipc."""
    if importlib.util.find_spec("zmq") is None:
        raise Missing("pyzmq is not installed (pip install '.[bench]')")
    with tempfile.TemporaryDirectory() as folder:
        return slowest(count, zmq_node, lambda i: (count, folder, rounds, size))


# -- pipes -----------------------------------------------------------------------------------------------


def pipe_node(i: int, ends: list[Any], rounds: int, size: int, results: Any) -> None:
    """The ends of this process' pipes."""
    for end in ends:
        end.send_bytes(b"")
    for end in ends:
        end.recv_bytes()
    results.put(lockstep(rounds, size, [end.send_bytes for end in ends], [end.recv_bytes for end in ends]))


def pipes(count: int, rounds: int, size: int) -> float:
    """multiprocessing.Pipe, one duplex pipe per edge."""
    ends: dict[int, list[Any]] = {i: [] for i in range(count)}
    edges = {tuple(sorted((i, j))) for i in range(count) for j in neighbours(i, count)}
    for i, j in sorted(edges):
        a, b = multiprocessing.Pipe()
        ends[i].append(a)
        ends[j].append(b)
    try:
        return slowest(count, pipe_node, lambda i: (ends[i], rounds, size))
    finally:
        for end in chain.from_iterable(ends.values()):
            end.close()


# -- MPI -------------------------------------------------------------------------------------------------


def mpi(count: int, rounds: int, size: int) -> float:
    """mpi4py, Neighbor_allgather on a periodic Cartesian ring; more processes than cores are allowed."""
    beside = Path(sys.executable).parent / "mpiexec"
    launcher = str(beside) if beside.exists() else shutil.which("mpiexec")
    if importlib.util.find_spec("mpi4py") is None or launcher is None:
        raise Missing("mpi4py or mpiexec is not installed (pip install '.[bench]')")
    program = [sys.executable, str(Path(__file__).with_name("mpi_ring.py")), str(rounds), str(size)]
    try:
        ended = subprocess.run(
            [launcher, "-n", str(count), *program], capture_output=True, text=True, timeout=PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        raise Missing(f"{rounds} rounds not done after {PATIENCE:g} s: MPI spins while it waits") from None
    if ended.returncode:
        raise Missing(f"mpiexec: {(ended.stderr or ended.stdout).strip().splitlines()[-1]}")
    return float(ended.stdout)
