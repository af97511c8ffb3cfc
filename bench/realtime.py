"""How short a tick may be: what was late or missing at several ticks. For a machine that is otherwise idle.

python bench/realtime.py [--seconds 5] [--repeat 3]
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import duio_mesh

TOPOLOGIES = Path(__file__).parent.parent / "topologies"
CASES = {"ring": (0.002, 0.005, 0.01, 0.02), "geometric_ring": (0.002, 0.005, 0.01), "relaxed_ring": (0.02, 0.05, 0.1)}


def measure(name: str, tick: float, seconds: float) -> dict[str, Any]:
    """Parts of the messages, steps and ticks of one run that were not in time."""
    steps = max(10, round(seconds / tick))
    changes = {"timing": {"mode": "realtime", "tick": tick}, "run.steps": steps}
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes))
    with tempfile.TemporaryDirectory() as folder:
        timing = duio_mesh.run(design, Path(folder) / "run").metrics["timing"]
    nodes = timing["nodes"].values()
    late, missing = sum(n["late"] for n in nodes), sum(n["missing"] for n in nodes)
    sent = sum(n["on_time"] for n in nodes) + late + missing
    return {
        "late": late / sent,
        "missing": missing / sent,
        "overruns": sum(n["overruns"] for n in nodes) / steps / len(nodes),
        "late ticks": timing["plant"]["late_ticks"] / steps,
        "worst tick": timing["plant"]["worst_lateness"],
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0, help="of every run")
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
    print("| topology | tick (ms) | late | missing | overruns | late ticks | worst tick (ms) |")
    print("|---|---|---|---|---|---|---|")
    for name, ticks in CASES.items():
        for tick in ticks:
            runs = [measure(name, tick, args.seconds) for _ in range(args.repeat)]
            worst = {key: max(run[key] for run in runs) for key in runs[0]}
            parts = " | ".join(f"{worst[key]:.2%}" for key in ("late", "missing", "overruns", "late ticks"))
            print(f"| {name} | {tick * 1e3:g} | {parts} | {worst['worst tick'] * 1e3:.2f} |", flush=True)


if __name__ == "__main__":
    main()
