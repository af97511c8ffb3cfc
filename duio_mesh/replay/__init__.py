"""One node of a finished run again, alone, from its tape: no Zenoh, nobody else, the same bits (docs/replay.md)."""

from __future__ import annotations

import os
from collections.abc import Sequence

ONE_THREAD = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def main(argv: Sequence[str]) -> int:
    """`launch.py replay RUN_DIR --node 3`; the exit code."""
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))  # before numpy is there: the node had one thread, too
    from duio_mesh.replay import command

    return command.main(argv)
