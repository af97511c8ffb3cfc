"""CPU seconds of large designs against a general semidefinite solver (cvxpy and Clarabel), in one process.

    python bench/design.py [--repeat 3] [--no-generic]      some three minutes, a third of it Clarabel at n = 25

Heat grids as of `launch.py new heat`: n rooms, 4 HVAC units and 1 disturbance; every node knows one unit and measures
the other four rooms. Ours runs --repeat times right before Clarabel and as often right after it; a
ratio is Clarabel's time to the median of ours. Process time, so other processes count little; cvxpy's import (a second)
is not counted. The last column is the peak memory of a process of its own for the whole design.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one core for both

import numpy as np
from interleave import machine
from scipy import linalg

import duio_mesh
from duio_mesh.generate import command
from duio_mesh.synthesis.consensus import Undetectable, couple
from duio_mesh.synthesis.lmi import design
from duio_mesh.synthesis.local_gain import Subsystem, hinf_gain
from duio_mesh.synthesis.uio import decouple, decouple_node

SIZES = (("5x5", 4), ("8x8", 4), ("12x12", 8), ("8x8", 64))
LARGEST = 25
"""Rooms up to which the general solver gets an answer: beyond, it runs out of memory."""
STATES = (9, 16, 25, 36)


def cpu(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds, and what came of them."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def against(ours: Callable[[], Any], theirs: Callable[[], Any] | None, repeat: int) -> tuple[float, Any, float, Any]:
    """Median CPU seconds and result of ours, and those of the other (nan, None) in the middle of our repetitions."""
    if theirs is None:
        return *cpu(ours), float("nan"), None
    ours()  # lazy imports, caches
    before = [cpu(ours) for _ in range(repeat)]
    other, found = cpu(theirs)
    times = before + [cpu(ours) for _ in range(repeat)]
    return statistics.median(t for t, _ in times), times[0][1], other, found


def peak(rooms: str, nodes: int) -> tuple[int, int]:
    """MB of a fresh process before and after the design."""
    command = [sys.executable, __file__, "--peak", rooms, str(nodes)]
    before, after = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-2:]
    return int(before), int(after)


def megabytes() -> int:
    """Peak resident memory of this process since its exec (ru_maxrss would begin with the parent's)."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) // 1024


def scenario(rooms: str, nodes: int) -> Any:
    """The heat grid of the generator."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "heat.yaml"
        with contextlib.redirect_stdout(io.StringIO()):
            command.main(["heat", "--rooms", rooms, "--nodes", str(nodes), "--hvac", "4", "--out", str(out)])
        return duio_mesh.load_scenario(out)


def parts(of: Any) -> tuple[list[Undetectable], np.ndarray]:
    """A_iu and U_i: what a node does not measure it does not see at all on these grids."""
    found = []
    for i, node in of.nodes.items():
        P = decouple_node(of, i).P
        U = np.eye(of.plant.n)[:, ~node.C.any(axis=0)]
        found.append(Undetectable(U.T @ P @ of.plant.A @ U, U))
    return found, of.graph.laplacian()


def generic_consensus(of: list[Undetectable], laplacian: np.ndarray) -> float:
    """beta_u by cvxpy and Clarabel: the least norm as a linear matrix inequality in g."""
    import cvxpy as cp

    A, U = linalg.block_diag(*[p.A for p in of]), np.hstack([p.U for p in of])
    sizes = [p.U.shape[1] for p in of]
    T = np.repeat(np.repeat(laplacian, sizes, axis=0), sizes, axis=1) * (U.T @ U)
    g = cp.Variable(len(of))
    owner = np.repeat(np.eye(len(of)), sizes, axis=0)
    problem = cp.Problem(cp.Minimize(cp.sigma_max(A - cp.diag(owner @ g) @ T)))
    problem.solve(solver="CLARABEL")
    return float(problem.value**2 - 1)


def generic_hinf(system: Subsystem) -> float:
    """beta of (34) by cvxpy and Clarabel."""
    import cvxpy as cp

    A, C, F = system
    d, p = F.shape
    P, Y, beta = cp.Variable((d, d), symmetric=True), cp.Variable((d, p)), cp.Variable()
    drive = cp.hstack([-Y, -P @ F])
    closed = P @ A - Y @ C
    M = cp.bmat(
        [
            [P, closed, drive, np.zeros((d, d))],
            [closed.T, P, np.zeros((d, 2 * p)), np.eye(d)],
            [drive.T, np.zeros((2 * p, d)), beta * np.eye(2 * p), np.zeros((2 * p, d))],
            [np.zeros((d, d)), np.eye(d), np.zeros((d, 2 * p)), beta * np.eye(d)],
        ]
    )
    cp.Problem(cp.Minimize(beta), [(M + M.T) / 2 >> 0]).solve(solver="CLARABEL")
    return float(beta.value)


def subsystem(d: int) -> Subsystem:
    """A random one with two measurements, one unknown input, and spectral radius 1.2."""
    rng = np.random.default_rng(d)
    A = rng.standard_normal((d, d))
    A *= 1.2 / np.abs(np.linalg.eigvals(A)).max()
    C, B = rng.standard_normal((2, d)), rng.standard_normal((d, 1))
    uio = decouple(C, B)
    return Subsystem(uio.P @ A, C, uio.E)


def line(*cells: str) -> None:
    """One row of a Markdown table."""
    print(f"| {' | '.join(cells)} |", flush=True)


def consensus(generic: bool, repeat: int) -> None:
    """norm: the coupling alone, and the whole design with its certificate."""
    head = ("rooms n", "nodes m", "coupling s", "Clarabel s", "ratio", "difference of beta_u", "gap to our lower bound")
    line(*head, "whole design s", "peak MB, of which imports")
    line(*["---:"] * 9)
    for rooms, nodes in SIZES:
        of = scenario(rooms, nodes)
        input_ = parts(of)
        theirs = (lambda given=input_: generic_consensus(*given)) if generic and of.plant.n <= LARGEST else None
        ours, best, other, beta = against(lambda given=input_: couple(*given, "norm"), theirs, repeat)
        whole, made = cpu(lambda of=of: design(of, lambda _: None))
        assert abs(best.beta - made.certificate["beta_u"]) < 1e-8
        rival = ["-", "-", "-"] if beta is None else [f"{other:.1f}", f"{other / ours:.0f}", f"{best.beta - beta:+.0e}"]
        before, after = peak(rooms, nodes)
        gap = f"{best.beta - best.lower:.0e}"
        line(str(of.plant.n), str(nodes), f"{ours:.2f}", *rival, gap, f"{whole:.2f}", f"{after}, {before}")


def hinf(generic: bool, repeat: int) -> None:
    """(34) on one node."""
    line("states", "here s", "Clarabel s", "ratio", "relative difference of beta")
    line(*["---:"] * 5)
    for d in STATES:
        system = subsystem(d)
        theirs = (lambda system=system: generic_hinf(system)) if generic else None
        ours, (_, beta), other, least = against(lambda system=system: hinf_gain(system, "node"), theirs, repeat)
        rival = ["-"] * 3 if least is None else [f"{other:.2f}", f"{other / ours:.0f}", f"{beta / least - 1:+.0e}"]
        line(str(d), f"{ours:.3f}", *rival)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--no-generic", action="store_true", help="without cvxpy and Clarabel")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--peak", nargs=2, metavar=("ROOMS", "NODES"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.peak:
        of, before = scenario(args.peak[0], int(args.peak[1])), megabytes()
        design(of, lambda _: None)
        print(before, megabytes())
        return
    warnings.simplefilter("ignore")  # Clarabel: "may be inaccurate"
    generic = not args.no_generic
    if generic:
        import cvxpy  # noqa: F401  its second of import is not counted
    print(f"{machine()}\n", flush=True)
    hinf(generic, args.repeat)
    print()
    consensus(generic, args.repeat)


if __name__ == "__main__":
    main()
