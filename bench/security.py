"""What security costs: speed and processor time of the same run open, with passwords and with certificates.

    python bench/security.py [--rounds 6000] [--repeat 5]

Two rings of four: `lmi` with one round a step (plant, journals and samples included) and `admm` with 199 rounds a step
(the exchange between nodes alone). The modes are interleaved in shuffled order; the ratios are within one repetition.
The processor time of a node (user and system, all threads, connecting included) depends least on what else runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import rings
from interleave import Results, interleaved, machine, table

from duio_mesh import launcher
from duio_mesh.scenario.model import Security
from duio_mesh.supervisor import Supervisor
from duio_mesh.synthesis.design import Design

MODES: tuple[Any, ...] = ("open", "password", "mtls")
ROUNDS = 199  # exchanges per step of the admm ring


def measure(design: Design, mode: Any, spent: dict[str, list[float]]) -> float:
    """Rounds per second of one run; microseconds of processor time per node and round are added to ``spent``."""
    guarded = dataclasses.replace(design, scenario=dataclasses.replace(design.scenario, security=Security(mode)))
    with tempfile.TemporaryDirectory() as out, Supervisor() as supervisor:
        result = launcher.run(guarded, Path(out) / "run", record=False, supervisor=supervisor)
        nodes = [p.done for who, p in supervisor.processes.items() if who.startswith("node-")]
    spent.setdefault(mode, []).append(statistics.mean(1e6 * n["cpu_seconds"] / n["rounds"] for n in nodes))
    return float(result.metrics["rounds_per_second"])


def main() -> None:
    """Print one table per ring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=6000)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    print(machine(), end="\n\n")
    runs = {
        "lmi, n = 9, four nodes": rings.lmi_ring(args.rounds),
        "admm, n = 6, four nodes": rings.admm_ring(4, max(1, args.rounds // ROUNDS), {"nu": ROUNDS + 1}),
    }
    for title, design in runs.items():
        spent: dict[str, list[float]] = {}
        results = interleaved({mode: partial(measure, design, mode, spent) for mode in MODES}, args.repeat)
        print(table(title, results, "open", "rounds/s"))
        ordered: Results = {mode: spent[mode] for mode in MODES}
        print(table(title, ordered, "open", "CPU us per node and round", "{:.1f}"))


if __name__ == "__main__":
    main()
