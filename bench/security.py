"""What security costs: rounds per second of the same run open, with passwords and with certificates.

    python bench/security.py [--rounds 6000] [--repeat 5]

Two rings of four: `lmi` with one round a step (plant, journals and samples included) and `admm` with 199 rounds a step
(the exchange between nodes alone). The modes are interleaved in shuffled order; the ratios are within one repetition.
"""

from __future__ import annotations

import argparse
import dataclasses
from functools import partial
from typing import Any

import rings
from interleave import interleaved, machine, table

from duio_mesh.scenario.model import Security
from duio_mesh.synthesis.design import Design

MODES: tuple[Any, ...] = ("open", "password", "mtls")
ROUNDS = 199  # exchanges per step of the admm ring


def speed(design: Design, mode: Any) -> float:
    """Rounds per second of one run."""
    guarded = dataclasses.replace(design.scenario, security=Security(mode))
    return float(rings.run_mesh(dataclasses.replace(design, scenario=guarded))["rounds_per_second"])


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
        results = interleaved({mode: partial(speed, design, mode) for mode in MODES}, args.repeat)
        print(table(title, results, "open", "rounds/s"))


if __name__ == "__main__":
    main()
