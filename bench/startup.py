"""From the command to the first step of the four-node building, against importing cvxpy and zenoh, interleaved.

    python bench/startup.py [--repeat 5]

The start includes reading the file, the design of all gains (cvxpy), seven processes and the start barrier. The first
step is when the plant has met its nodes and its recorder and begins to step: the `ready` event of logs/plant.jsonl.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from interleave import interleaved, machine, table

HOME = Path(__file__).parent.parent
IMPORTS = "import of cvxpy and zenoh"


def first_step() -> float:
    """Seconds from the command until the plant begins to step."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, str(HOME / "launch.py"), str(HOME / "topologies" / "partitioned.yaml")]
        begin = time.time()
        subprocess.run([*command, "--steps", "20", "--out", str(out)], stdout=subprocess.DEVNULL, check=False)
        events = [json.loads(line) for line in (out / "logs" / "plant.jsonl").read_text().splitlines()]
    return next(float(event["time"]) for event in events if event["event"] == "ready") - begin


def imports() -> float:
    """Seconds of an interpreter that imports the two heaviest libraries, and ends."""
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import cvxpy, zenoh"], check=True)
    return time.perf_counter() - begin


def main() -> None:
    """Interleave and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    print(f"{machine()}; {args.repeat} repetitions\n", flush=True)
    found = interleaved({IMPORTS: imports, "command to first step": first_step}, args.repeat)
    print(table("partitioned.yaml, four nodes", found, IMPORTS, "s", "{:.2f}"))


if __name__ == "__main__":
    main()
