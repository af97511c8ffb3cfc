"""One step of a node in words and columns: what it was given, what it made of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import zip_longest

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.observers.base import Estimate
from duio_mesh.replay.compare import NAMES, Kept
from duio_mesh.replay.player import Block, Round
from duio_mesh.spec import NodeSpec

FEW = 3  # rounds that are shown without being asked for; of more, the first and the last

Say = Callable[[str], None]


def show_block(say: Say, spec: NodeSpec, block: Block, k: int, r: int | None, run: Kept | None) -> None:
    """Print step k of this block; ``r``: the exchange that is wanted, or None; the block has it."""
    together = f", fused with steps {block.first} to {block.steps[-1]}" if len(block.steps) > 1 else ""
    say(f"node {spec.id}, step {k}: {spec.method}, {in_words(block.exchanged)}{together}")
    for call in block.calls:
        said = ", ".join(f"[{_numbers(a)}]" if isinstance(a, np.ndarray) else str(a) for a in call.arguments)
        say(f"  told before: {call.name}({said})")
    sample = block.samples[k - block.first]
    say(f"  y  {_numbers(sample.y)}\n  u  {_numbers(sample.u)}")
    chosen = [one for one in block.rounds if r is None or one.r == r]
    for one in chosen if len(chosen) <= FEW else (chosen[0], chosen[-1]):
        say(f"round {one.r}")
        _show(say, _exchange(spec, one))
    if len(chosen) > FEW:
        say(f"  {len(chosen) - 2} rounds between these two are not shown (--round R)")
    say("estimate")
    _show(say, _estimate(block, k, run))
    if block.flagged:
        say("  the observer marks this estimate: messages were missing that it needs")


def in_words(exchanges: int) -> str:
    """How many there were."""
    return "1 exchange" if exchanges == 1 else f"{exchanges} exchanges"


def _exchange(spec: NodeSpec, one: Round) -> Iterator[Sequence[str]]:
    """Own vector, neighbours' vectors, and late ones, side by side; the header first."""
    header, columns = ["", "own"], [one.own]
    for j in sorted(spec.hears):
        came = one.received.get(j)
        header.append(f"from {j}" if came is not None else f"from {j}: nothing")
        columns.append(one.own[:0] if came is None else came)
    for late in one.late:
        age = f"{late.steps} steps ago, " if late.steps else ""
        header.append(f"late from {late.source}: {age}round {late.round}")
        columns.append(late.vector)
    yield header
    size = max(column.size for column in columns)
    for at, values in enumerate(zip_longest(*columns)):
        name = "doubt" if spec.without and at == size - 1 else str(at + 1)
        yield name, *("" if v is None else _number(v) for v in values)


def _estimate(block: Block, k: int, run: Kept | None) -> Iterator[Sequence[str]]:
    """Before and after; beside it what the run kept, and the truth. The header first."""
    at = k - block.first
    before = block.estimates[at - 1] if at and block.estimates else block.before
    after = block.estimates[at] if block.estimates else None
    row = run.row(k) if run else None
    truth = run.truth[k] if run and run.truth is not None and k < len(run.truth) else None
    yield "", "before", "after", "change", "in the run", "truth", "error"
    for part in Estimate._fields:
        for c in range(getattr(after or before, part).size if after or before else 0):
            old, new = (None if e is None else float(getattr(e, part)[c]) for e in (before, after))
            ran = None if row is None else float(row[part][c])
            x = float(truth[c]) if truth is not None and part == "state" else None
            cells = (old, new, _minus(new, old), ran, x, _minus(new, x))
            yield f"{NAMES[part]}{c + 1}", *("-" if v is None else _number(v) for v in cells)


def _minus(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else a - b


def _show(say: Say, rows: Iterator[Sequence[str]]) -> None:
    """Right-aligned columns, as wide as they are."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    for row in table:
        say("  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def _number(value: float) -> str:
    return f"{value:.10g}"


def _numbers(vector: Array) -> str:
    return "  ".join(map(_number, vector)) or "-"
