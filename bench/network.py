"""Rounds per second from round-trip time, degree, payload and processors: a model, fitted on loopback, tested on wires.

    python bench/network.py [--seconds 1.5] [--repeat 3] [--write]

The mesh's own exchange between processes that do nothing else, every one with ``degree`` neighbours (a circulant
graph). On loopback the processor is the limit, and the three constants of the model are fitted there. The rows with a
delay or a rate run between network namespaces (bench/wires.py) and are predictions: nothing is fitted to them, and the
round-trip time in the prediction is the one that a byte took there and back over TCP just before. docs/scaling.md has
the model; the last table is what it says for 10,000 sensors.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import statistics
import subprocess
import sys
import time
from typing import Any, NamedTuple

from interleave import Missing, machine
from page import Page
from wires import Wires, address

PORT, PINGS = 7447, 30
PATIENCE = 60.0  # seconds
HEADERS = 66 + 20  # bytes around a frame of ours: Ethernet, IP and TCP with time stamps; and Zenoh's own, about
CORES = os.cpu_count() or 1


class Point(NamedTuple):
    """One measurement."""

    nodes: int
    degree: int
    numbers: int  # doubles in a message
    rtt: float = 0.0  # seconds there and back that the wire adds; measured later
    rate: float = 0.0  # bits per second that a node may send; 0: no limit
    wired: bool = False  # between namespaces

    def frame(self) -> int:
        """Bytes of one message on the wire."""
        from duio_mesh.mesh.frames import Encoder

        return len(Encoder("00000000", "node-1")(0, 0, _vector(self.numbers))) + HEADERS

    def neighbours(self, i: int) -> list[int]:
        """Of node i: the nearest on both sides of a circle."""
        half, found = self.degree // 2, set()
        for step in range(1, half + 1):
            found |= {(i - step) % self.nodes, (i + step) % self.nodes}
        if self.degree % 2:  # the one opposite
            found.add((i + self.nodes // 2) % self.nodes)
        return sorted(found - {i})


LOOPBACK = [Point(n, d, s) for n, d in ((2, 1), (3, 2), (5, 4), (8, 2), (8, 4), (16, 2)) for s in (6, 600)]
WIRED = [
    *(Point(2, 1, 6, rtt, wired=True) for rtt in (0.0, 0.002, 0.01, 0.05, 0.1)),
    Point(3, 2, 6, 0.01, wired=True),
    Point(5, 4, 6, 0.01, wired=True),
    Point(5, 4, 600, 0.05, wired=True),
    Point(2, 1, 6, 0.0, 1e6, wired=True),
    Point(2, 1, 600, 0.0, 1e6, wired=True),
    Point(5, 4, 600, 0.0, 1e7, wired=True),
    Point(3, 2, 600, 0.02, 1e7, wired=True),
]


def _vector(numbers: int) -> Any:
    import numpy as np

    return np.arange(float(numbers))


# -- what runs in the processes ----------------------------------------------------------------------------------


def node(order: dict[str, Any]) -> None:
    """Exchange for so many rounds with all neighbours; prints the seconds that they took."""
    from duio_mesh.mesh import Mesh
    from duio_mesh.mesh.lockstep import Exchange, Line, Lockstep
    from duio_mesh.spec import Wire

    if hasattr(os, "SCHED_BATCH"):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    i, near, vector = order["id"], order["neighbours"], _vector(order["numbers"])
    wire = Wire("00000000", (order["at"][i],), tuple(order["at"][j] for j in near if j < i))
    with Mesh(wire, f"node-{i}") as mesh:
        keys, lockstep = mesh.keys, Lockstep(mesh, PATIENCE)
        heard = {j: Line(mesh, keys.edge(j, i), f"{j} -> {i}", f"node-{j}", (j, i), 1) for j in near}
        told = mesh.speak([(keys.edge(i, j), f"{i} -> {j}", (i, j)) for j in near])
        mesh.meet()
        with lockstep:
            exchange = Exchange(lockstep, told, heard)
            for r in range(order["warm"]):
                exchange(0, r, vector)
            begin = time.monotonic()
            for r in range(order["rounds"]):
                exchange(1, r, vector)
            print(time.monotonic() - begin, flush=True)
            exchange(2, 0, vector)  # nobody leaves before all are done


def pong(order: dict[str, Any]) -> None:
    """Give back every byte."""
    with socket.create_server((order["address"], PORT)) as server:
        print("ready", flush=True)
        link, _ = server.accept()
        with link:
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while data := link.recv(1):
                link.sendall(data)


def ping(order: dict[str, Any]) -> None:
    """Prints the median seconds of a byte there and back."""
    took = []
    with socket.create_connection((order["address"], PORT), timeout=PATIENCE) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for _ in range(PINGS):
            begin = time.perf_counter()
            link.sendall(b"x")
            link.recv(1)
            took.append(time.perf_counter() - begin)
    print(statistics.median(took), flush=True)


ROLES = {"node": node, "pong": pong, "ping": ping}


# -- measuring -----------------------------------------------------------------------------------------------------


def start(role: str, order: dict[str, Any], wires: Wires | None, host: int) -> subprocess.Popen[str]:
    """One process, on its host."""
    command = [sys.executable, __file__, "--as", role, json.dumps(order)]
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    command = wires.inside(host, command) if wires else command
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def answer(process: subprocess.Popen[str]) -> float:
    """The number that a process prints."""
    said, _ = process.communicate(timeout=PATIENCE + 60)
    if process.returncode:
        raise RuntimeError(f"{process.args} ended with {process.returncode}")
    return float(said)


def round_trip(wires: Wires) -> float:
    """Seconds of a byte from host 1 to host 0 and back."""
    order = {"address": address(0)}
    other = start("pong", order, wires, 0)
    assert other.stdout is not None
    other.stdout.readline()
    try:
        return answer(start("ping", order, wires, 1))
    finally:
        other.wait(PATIENCE)
        other.stdout.close()


def seconds_a_round(point: Point, rounds: int, wires: Wires | None) -> float:
    """Of the slowest process."""
    at = [f"tcp/{address(i)}:{PORT}" for i in range(point.nodes)] if wires else loopback(point.nodes)
    processes = []
    for i in range(point.nodes):
        order = {"id": i, "neighbours": point.neighbours(i), "numbers": point.numbers, "at": at}
        order |= {"rounds": rounds, "warm": max(3, rounds // 10)}
        processes.append(start("node", order, wires, i))
    return max(map(answer, processes)) / rounds


def loopback(count: int) -> list[str]:
    """Endpoints with free ports."""
    held = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [s.getsockname()[1] for s in held]
    for s in held:
        s.close()
    return [f"tcp/127.0.0.1:{port}" for port in ports]


def measure(point: Point, seconds: float, repeat: int, guess: float) -> tuple[Point, list[float]]:
    """The point with its round-trip time as measured, and seconds a round, once per repetition."""
    rounds = max(50, min(20_000, round(seconds / guess)))
    if not point.wired:
        return point, [seconds_a_round(point, rounds, None) for _ in range(repeat)]
    with Wires(point.nodes, point.rtt / 2) as wires:  # the rate limits bytes, and is counted apart from the time
        rtt = round_trip(wires)
    with Wires(point.nodes, point.rtt / 2, point.rate) as wires:
        return point._replace(rtt=rtt), [seconds_a_round(point, rounds, wires) for _ in range(repeat)]


# -- the model -----------------------------------------------------------------------------------------------------


class Model(NamedTuple):
    """Seconds a round = rtt / 2 + work + degree * bits of a message / rate."""

    base: float  # seconds of processor time of a round, whoever the neighbours are
    message: float  # seconds per neighbour: one message sent and one received
    byte: float  # seconds per byte of payload and neighbour

    def work(self, degree: float, numbers: float) -> float:
        """Seconds of processor time of one node and round."""
        return self.base + degree * (self.message + self.byte * 8 * numbers)

    def round(self, p: Point) -> float:
        """Seconds of a round. A process has a processor to itself, or its share of one."""
        wire = p.degree * 8 * p.frame() / p.rate if p.rate else 0.0
        return p.rtt / 2 + max(1.0, p.nodes / CORES) * self.work(p.degree, p.numbers) + wire


def fit(points: list[tuple[Point, float]]) -> Model:
    """Least squares of the relative residuals over the loopback points, constants not negative."""
    import numpy as np
    from scipy.optimize import nnls

    rows = np.array([[1.0, p.degree, p.degree * 8.0 * p.numbers] for p, _ in points])
    share = np.array([max(1.0, p.nodes / CORES) for p, _ in points])
    times = np.array([t for _, t in points])
    return Model(*nnls(rows * (share / times)[:, None], np.ones(len(points)))[0])


def residuals(page: Page, model: Model, found: list[tuple[Point, list[float]]]) -> None:
    """Measured against predicted."""
    page.say("| where | nodes | degree | doubles | RTT, ms | rate | ms a round | predicted | residual |")
    page.say("|---|---|---|---|---|---|---|---|---|")
    for p, times in found:
        said, seen = model.round(p), statistics.median(times)
        span = f"{1e3 * seen:.3g} [{1e3 * min(times):.3g} - {1e3 * max(times):.3g}]"
        where = "namespaces" if p.wired else "loopback"
        rate = f"{p.rate / 1e6:g} Mbit/s" if p.rate else "-"
        rtt = f"{1e3 * p.rtt:.3g}" if p.wired else "-"
        cells = (where, p.nodes, p.degree, p.numbers, rtt, rate, span, f"{1e3 * said:.3g}", f"{said / seen - 1:+.0%}")
        page.say(f"| {' | '.join(map(str, cells))} |")


# -- ten thousand sensors --------------------------------------------------------------------------------------------

NETS = {"in one city": (0.005, 1e8), "across a continent": (0.04, 1e7), "around the world": (0.2, 1e7)}
METHODS = (  # (method, graph, degree, exchanges a step, steps a batch)
    ("lmi, augmented, geometric, reduced_order", "ring", 2, 1, 1),
    ("lmi, augmented, geometric, reduced_order", "grid 100 x 100", 4, 1, 1),
    ("lmi, augmented, geometric, reduced_order", "H(4, 10)", 36, 1, 1),
    ("admm, nu = 60", "H(4, 10)", 36, 59, 1),
    ("admm, nu = 200", "H(4, 10)", 36, 199, 1),
    ("admm, nu = 200, batch 64", "H(4, 10)", 36, 199, 64),
    ("admm, nu = 20 N", "grid 100 x 100", 4, 199_999, 1),
    ("anything exact (the diameter)", "grid 100 x 100", 4, 198, 1),
    ("finite_time", "ring", 2, 5000, 1),
    ("finite_time, batch 64", "ring", 2, 5000, 64),
    ("finite_time", "H(4, 10)", 36, 4, 1),
    ("finite_time, batch 8", "H(4, 10)", 36, 4, 8),
    ("finite_time, batch 64", "H(4, 10)", 36, 4, 64),
    ("finite_time", "H(2, 100)", 198, 2, 1),
)


def predictions(page: Page, model: Model, numbers: int) -> None:
    """Steps per second, every sensor with a processor of its own."""
    page.say(f"| 10,000 sensors, n = {numbers} | graph | degree | exchanges a step | {' | '.join(NETS)} |")
    page.say(f"|---|---|---|---|{'---|' * len(NETS)}")
    for method, graph, degree, exchanges, batch in METHODS:
        cells = []
        for rtt, rate in NETS.values():
            p = Point(1, degree, numbers * batch, rtt, rate, wired=True)
            cells.append(f"{batch / (exchanges * model.round(p)):.3g}")
        page.say(f"| {method} | {graph} | {degree} | {exchanges} | {' | '.join(cells)} |")


def main() -> None:
    """Measure, fit, predict."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=1.5, help="of one measurement, about")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/scaling.md")
    parser.add_argument("--as", nargs=2, dest="role", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.role:
        ROLES[args.role[0]](json.loads(args.role[1]))
        return
    page = Page("scaling.md", "network")
    page.say(f"{machine()}; {args.repeat} repetitions\n")
    found = [measure(p, args.seconds, args.repeat, 1e-4 * p.nodes * p.degree) for p in LOOPBACK]
    model = fit([(p, statistics.median(times)) for p, times in found])
    microseconds = (f"{1e6 * model.base:.1f} us", f"{1e6 * model.message:.1f} us", f"{1e9 * model.byte:.2f} ns")
    page.say("base {}, per neighbour {}, per byte and neighbour {}\n".format(*microseconds))
    try:
        found += [measure(p, args.seconds, args.repeat, model.round(p)) for p in WIRED]
    except Missing as e:
        page.say(f"{e}; loopback only\n")
    residuals(page, model, found)
    for numbers in (6, 64):
        page.say()
        predictions(page, model, numbers)
    if args.write:
        page.write()


if __name__ == "__main__":
    main()
