"""What came of a replay, and how that is said."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from duio_mesh.errors import DuioError
from duio_mesh.replay.compare import Difference, Kept, difference
from duio_mesh.replay.player import Block
from duio_mesh.replay.tables import in_words
from duio_mesh.spec import NodeSpec
from duio_mesh.tape import Head, ingredients

Say = Callable[[str], None]


class ReplayError(DuioError):
    """There is nothing to replay or to compare with (exit 2); the message says what is missing and what to do."""


class Outcome:
    """Counts what is the same and what is not."""

    def __init__(self, spec: NodeSpec, run: Kept | None, wanted: range) -> None:
        """``run``: what the run kept of this node; ``wanted``: the steps to compare."""
        self._spec, self._run, self._wanted = spec, run, wanted
        self._heads: list[Head] = []
        self._steps = self._equal = self._different = 0
        self._last = -1  # step that was replayed to its estimate
        self._first: Difference | None = None
        self._infinite: int | None = None  # the first step whose estimate is not finite
        self._unfinished: list[Block] = []  # that never came to their estimates

    def take(self, block: Block) -> None:
        """Count one block."""
        if block.head not in self._heads:
            self._heads.append(block.head)
        if not block.estimates:
            self._unfinished.append(block)
            return
        self._last = block.steps[-1]
        for k, estimate in zip(block.steps, block.estimates, strict=True):
            self._steps += 1
            if self._infinite is None and not np.isfinite(estimate.state).all():
                self._infinite = k
            row = self._run.row(k) if self._run and k in self._wanted else None
            if row is None:
                continue
            apart = difference(k, row, estimate)
            self._equal += apart is None
            self._different += apart is not None
            self._first = self._first or apart

    def ending(self) -> str:
        """How far the tape went."""
        return f"its last is step {self._last}" if self._steps else "it ends before its first step is done"

    def verdict(self, say: Say) -> bool:
        """Say what came of it; whether everything is the same. Raises ReplayError when nothing could be compared."""
        spec = self._spec
        for head in self._heads[1:]:
            say(f"process {head.incarnation + 1} of node {spec.id} begins at step {head.first}")
        for block in self._unfinished:
            self._say_unfinished(block, say)
        if self._infinite is not None:
            say(f"the estimate of step {self._infinite} is not finite")
        if self._first or any(block.went_on for block in self._unfinished):
            self._say_difference(say)
            return False
        if self._run is None:
            raise ReplayError(
                f"replayed {self._steps} steps of node {spec.id}, but there is nothing to compare them with: the run "
                "left neither trace.npz nor rows"
            )
        source, last = self._run.source, self._run.last
        if not self._equal:
            raise ReplayError(
                f"replayed {self._steps} steps of node {spec.id}, but {source} has no row for any that was to be "
                f"compared (its last is of step {last})"
            )
        say(f"node {spec.id} ({spec.method}): {self._equal} steps are equal to {source}, bit for bit")
        if last > self._last and self._wanted.stop == spec.steps:
            say(f"{source} goes on to step {last}; of the tape {self.ending()}")
        if self._last > last:
            say(f"the tape goes on to step {self._last}; {source} ends with step {last}")
        return True

    def _say_unfinished(self, block: Block, say: Say) -> None:
        steps = block.steps
        where = f"step {block.first}" if len(steps) < 2 else f"steps {block.first} to {steps[-1]}"
        where += f", after {in_words(block.exchanged)}"
        if block.failure is None:
            say(f"the tape of process {block.head.incarnation + 1} of node {self._spec.id} ends in {where}")
            return
        text = f"{type(block.failure).__name__}: {block.failure}"
        say(
            f"the observer fails in {where}: {text} "
            f"({'in the run it did not' if block.went_on else 'so it did in the run: the tape ends there'})"
        )

    def _say_difference(self, say: Say) -> None:
        if self._first and self._run:
            k, name, run, replay = self._first
            say(
                f"node {self._spec.id} ({self._spec.method}): {self._different} of {self._equal + self._different} "
                f"steps differ from {self._run.source}, the first is step {k}:\n"
                f"  {name}  run {run!r}  replay {replay!r}  difference {replay - run:.3g}"
            )
        words = {"spec": "the matrices or options in the spec"}
        now = ingredients(self._spec)
        for name, then in self._heads[0].made.items():
            if now.get(name) != then:
                values = "" if name == "spec" else f" ({then} then, {now.get(name)} now)"
                say(f"  not as in the run: {words.get(name, name)}{values}")
