"""`python launch.py replay RUN_DIR --node 3`: reads spec and tape, replays, compares, and says what came of it."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from duio_mesh.observers import make_observer
from duio_mesh.observers.base import Estimate
from duio_mesh.replay.compare import kept
from duio_mesh.replay.outcome import Outcome, ReplayError
from duio_mesh.replay.player import Block, play
from duio_mesh.replay.tables import show_block
from duio_mesh.spec import NodeSpec, read_spec
from duio_mesh.tape import read_tape

SAME, DIFFERENT, IMPOSSIBLE, INTERRUPTED = 0, 1, 2, 130
PATIENCE = 2.0  # seconds before there is a progress bar

EPILOG = """\
exit codes: 0 every estimate that the run kept is the same, bit for bit; 1 one differs; 2 there is nothing to replay or
to compare with (the message says what is missing and what to do); 130 interrupted.

A run keeps its nodes' tapes when it is started with --inputs, or with `inputs: true` under `run` in the topology file.

examples:
  python launch.py topologies/ring.yaml --inputs
  python launch.py replay runs/heat-ring/latest --node 3
  python launch.py replay runs/heat-ring/latest --node 3 --step 37          what it was given and what it made of it
  python launch.py replay runs/heat-ring/latest --node 3 --step 37 --pdb    and stop there in the debugger
"""


def parser() -> argparse.ArgumentParser:
    """The options of `replay`."""
    p = argparse.ArgumentParser(
        prog="launch.py replay",
        description="Run one node of a finished run again, alone, from the tape of its inputs (docs/replay.md).",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("folder", type=Path, metavar="RUN_DIR", help="the run's folder")
    p.add_argument("--node", type=int, required=True, metavar="I", help="which node")
    p.add_argument("--from", type=_step, default=0, metavar="K", dest="begin", help="first step to compare and write")
    p.add_argument("--until", type=_step, metavar="K", help="last step to replay; it is compared and written, too")
    p.add_argument("--out", type=Path, metavar="FILE", help="write the replayed steps to this .npz file")
    p.add_argument("--step", type=_step, metavar="K", help="show this step: inputs, neighbours' vectors, estimate")
    p.add_argument("--round", type=_step, metavar="R", help="with --step: this exchange of the step")
    p.add_argument("--pdb", action="store_true", help="with --step: stop in the debugger before the step begins")
    return p


def _step(text: str) -> int:
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"should be a whole number from 0, not {text}")
    return number


def main(argv: Sequence[str]) -> int:
    """Replay as asked; the exit code."""
    p = parser()
    args = p.parse_args(argv)
    if args.step is None and (args.pdb or args.round is not None):
        p.error("--pdb and --round belong to a step: use them with --step")
    if args.until is not None and args.until < max(args.begin, args.step or 0):
        p.error("--until comes before --from or --step")
    if args.until is None:
        args.until = args.step  # None: to the end of the tape
    try:
        return _main(args)
    except (ReplayError, ValueError, OSError) as e:
        print(e, file=sys.stderr)
        return IMPOSSIBLE
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def find(folder: Path, node: int) -> tuple[NodeSpec, Path]:
    """The node's spec and where its tape is.

    Raises ReplayError naming what is missing and what to do about it, ValueError when the spec is damaged, OSError.
    """
    if not (folder / "nodes").is_dir():
        raise ReplayError(f"{folder} is not the folder of a run: it has no nodes/")
    ids = sorted(int(path.stem.removeprefix("node-")) for path in (folder / "nodes").glob("node-*.spec"))
    if node not in ids:
        there = ", ".join(map(str, ids)) or "none (a run in one process has no node processes)"
        raise ReplayError(f"{folder} has no node {node}; its nodes are {there}")
    tape = folder / "inputs" / f"node-{node}.tape"
    if not tape.exists():
        raise ReplayError(
            f"node {node} of {folder} kept no tape of its inputs (there is no inputs/{tape.name}): "
            "run again with --set run.inputs=true"
        )
    spec = read_spec(folder / "nodes" / f"node-{node}.spec", NodeSpec)
    if spec.id != node:
        raise ReplayError(f"{folder}/nodes/node-{node}.spec is the spec of node {spec.id}")
    return spec, tape


def _main(args: argparse.Namespace) -> int:
    spec, tape = find(args.folder, args.node)
    if args.out and args.out.exists():
        raise ReplayError(f"--out {args.out} already exists; nothing is overwritten")
    run = kept(args.folder, spec.id, _nothing_yet(spec))
    halt = breakpoint if args.pdb else lambda: None
    blocks = play(spec, read_tape(tape), args.step, halt)
    rows: list[tuple[Block, int]] = []
    wanted = range(args.begin, spec.steps if args.until is None else args.until + 1)
    outcome, shown = Outcome(spec, run, wanted), False
    for block in _with_progress(blocks, spec.steps, hidden=args.pdb):
        outcome.take(block)
        if args.step in block.steps:
            shown = True
            _check_round(block, args.step, args.round)
            show_block(print, spec, block, args.step, args.round, run)
        if args.out and block.estimates:
            rows += [(block, at) for at, k in enumerate(block.steps) if k in wanted]
        if block.steps.stop >= wanted.stop:
            break
    if args.out:
        _write(args.out, rows)
    if args.step is not None and not shown:
        raise ReplayError(f"step {args.step} is not on the tape of node {spec.id}: {outcome.ending()}")
    return SAME if outcome.verdict(print) else DIFFERENT


def _check_round(block: Block, k: int, r: int | None) -> None:
    """Raise ReplayError when round r is wanted of step k, and there is none in its block."""
    there = [one.r for one in block.rounds]
    if r is not None and r not in there:
        raise ReplayError(f"there is no round {r} in step {k}; its rounds are {_span(there)}")


def _span(numbers: Sequence[int]) -> str:
    """'0 to 3', '0 only' or 'none'."""
    if len(numbers) > 1:
        return f"{numbers[0]} to {numbers[-1]}"
    return f"{numbers[0]} only" if numbers else "none"


def _nothing_yet(spec: NodeSpec) -> Estimate:
    """An estimate with the sizes of this observer's. Raises ReplayError when the spec makes none."""
    try:
        return make_observer(spec).estimate()
    except (ValueError, KeyError, TypeError, IndexError) as e:
        raise ReplayError(f"the spec of node {spec.id} makes no observer: {type(e).__name__}: {e}") from None


def _with_progress(blocks: Iterable[Block], steps: int, *, hidden: bool) -> Iterator[Block]:
    """The same blocks, with a bar for who waits longer than ``PATIENCE``."""
    due = time.monotonic() + PATIENCE
    with contextlib.ExitStack() as stack:
        bar: Progress | None = None
        for block in blocks:
            if bar is None and time.monotonic() >= due and not hidden:
                bar = stack.enter_context(Progress(console=Console(stderr=True), transient=True))
                bar.add_task("replaying", total=steps)
            if bar:
                bar.update(bar.task_ids[0], completed=block.steps.stop)
            yield block


def _write(path: Path, rows: Sequence[tuple[Block, int]]) -> None:
    """The replayed steps: step, flagged (K,), xhat (K, n), y (K, p), u (K, m), where there are any what and vhat."""
    estimates = [block.estimates[at] for block, at in rows]
    arrays: dict[str, Any] = {
        "step": np.array([block.first + at for block, at in rows], dtype=np.int64),
        "flagged": np.array([block.flagged for block, _ in rows], dtype=bool),
        "y": np.array([block.samples[at].y for block, at in rows]),
        "u": np.array([block.samples[at].u for block, at in rows]),
    }
    for name, part in zip(("xhat", "what", "vhat"), Estimate._fields, strict=False):
        values = np.array([getattr(estimate, part) for estimate in estimates])
        if values.size:
            arrays[name] = values
    with path.open("xb") as f:
        np.savez(f, allow_pickle=False, **arrays)
