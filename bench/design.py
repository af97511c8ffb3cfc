"""CPU seconds of large designs against a general semidefinite solver (cvxpy and Clarabel), interleaved in one process.

    python bench/design.py [--generic]      without --generic only what is ours (the solver takes minutes at n = 25)

Heat grids as of `launch.py new heat`: n rooms, 4 HVAC units and 1 disturbance; every node knows one unit and measures
the other four rooms. The last columns: the difference of the two optima, and the peak memory of the process so far.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import resource
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import linalg

import duio_mesh
from duio_mesh.generate import command
from duio_mesh.synthesis.consensus import Undetectable, couple
from duio_mesh.synthesis.lmi import design
from duio_mesh.synthesis.local_gain import Subsystem, hinf_gain
from duio_mesh.synthesis.uio import decouple, decouple_node

SIZES = (("5x5", 4), ("8x8", 4), ("12x12", 8))
STATES = (9, 16, 25, 36)


def cpu(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds, and what came of them."""
    start = time.process_time()
    result = work()
    return time.process_time() - start, result


def megabytes() -> int:
    """Peak resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


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


def consensus(sizes: tuple[tuple[str, int], ...], generic: bool) -> None:
    """norm: the coupling alone, and the whole design with its certificate."""
    line("rooms n", "nodes m", "coupling s", "whole design s", "Clarabel s", "ratio", "difference", "peak MB")
    line(*["---:"] * 8)
    for rooms, nodes in sizes:
        of = scenario(rooms, nodes)
        ours, best = cpu(lambda of=of: couple(*parts(of), "norm"))
        whole, made = cpu(lambda of=of: design(of, lambda _: None))
        peak = megabytes()
        theirs = ["-", "-", "-"]
        if generic and of.plant.n <= 25:
            other, beta = cpu(lambda of=of: generic_consensus(*parts(of)))
            theirs = [f"{other:.1f}", f"{other / ours:.0f}", f"{best.beta - beta:+.0e}"]
        assert abs(best.beta - made.certificate["beta_u"]) < 1e-6
        line(str(of.plant.n), str(nodes), f"{ours:.2f}", f"{whole:.2f}", *theirs, str(peak))


def hinf(generic: bool) -> None:
    """(34) on one node."""
    line("states", "here s", "Clarabel s", "ratio", "relative difference")
    line(*["---:"] * 5)
    for d in STATES:
        system = subsystem(d)
        ours, (_, beta) = cpu(lambda system=system: hinf_gain(system, "node"))
        theirs = ["-", "-", "-"]
        if generic:
            other, least = cpu(lambda system=system: generic_hinf(system))
            theirs = [f"{other:.2f}", f"{other / ours:.0f}", f"{beta / least - 1:+.0e}"]
        line(str(d), f"{ours:.3f}", *theirs)


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generic", action="store_true", help="also run cvxpy and Clarabel where they still can")
    parser.add_argument("--largest", type=int, default=len(SIZES), help="how many of the sizes (default all)")
    args = parser.parse_args()
    warnings.simplefilter("ignore")  # Clarabel: "may be inaccurate"
    if args.generic:
        import cvxpy  # noqa: F401  its second of import is not counted
    hinf(args.generic)
    print()
    consensus(SIZES[: args.largest], args.generic)


if __name__ == "__main__":
    main()
