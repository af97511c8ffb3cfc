"""The figure of docs/reliability.md: what lost messages do to plain ADMM, and to the relaxed fusion, in the oracle.

    python bench/admm_loss.py            print the numbers
    python bench/admm_loss.py --write    and write docs/figures/admm_loss.png and the table in docs/reliability.md

Seed 002's ring of four nodes. Every directed message is lost for itself, so that nearly all losses are one-way. The
error is the largest component of x-hat - x; the components of x are below 3. Same seeds, same bits; a minute of CPU.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from duio_mesh import load_scenario, simulate, synthesise

ROOT = Path(__file__).parent.parent
PAGE, FIGURE = ROOT / "docs" / "reliability.md", ROOT / "docs" / "figures" / "admm_loss.png"
BEGIN, END = "<!-- losses in ADMM -->\n", "<!-- end of losses in ADMM -->\n"
SEED = 2026  # of the faults; the plant keeps the topology's own seed
STEPS, FIRST = 140, 100  # of the run, and the first that counts: the plant starts in zero, where nothing can be lost
ROUNDS = (10, 20, 40, 60, 100, 150, 200, 300)  # iterations; every step starts afresh
TABLE = 100  # the rounds of the table and of the right picture
CURVES = [("plain", p) for p in (0, 0.001, 0.01, 0.1)] + [("relaxed", p) for p in (0, 0.1, 0.5)]
FUSIONS = {"plain": ("admm_ring", "observer.nu"), "relaxed": ("relaxed_ring", "observer.rounds")}


class Run(NamedTuple):
    """One run of the oracle."""

    error: Any  # (N, K)
    flagged: Any  # (N, K)


def run(fusion: str, loss: float, rounds: int) -> Run:
    """Steps with so many iterations each, of which the messages get lost with probability ``loss``."""
    topology, name = FUSIONS[fusion]
    faults = {"faults": {"seed": SEED, "links": [{"loss": loss}]}} if loss else {}
    scenario = load_scenario(ROOT / "topologies" / f"{topology}.yaml", **{name: rounds, "run.steps": STEPS}, **faults)
    trace = simulate(synthesise(scenario))
    error = np.abs(trace.xhat - trace.x).max(axis=2)
    flags = np.zeros(error.shape, dtype=bool) if trace.flagged is None else trace.flagged
    return Run(error[:, FIRST:], flags[:, FIRST:])


def rows(found: dict[tuple[str, float, int], Run]) -> Iterator[str]:
    """The table in Markdown."""
    yield f"Seed of the faults {SEED}; steps {FIRST} to {STEPS - 1}, of {TABLE} iterations each."
    yield ""
    yield "| fusion | loss | median error | worst error | flagged | worst error not flagged |"
    yield "|---|---|---|---|---|---|"
    for fusion, loss in CURVES:
        error, flags = found[fusion, loss, TABLE]
        trusted = f"{error[~flags].max():.1e}" if not flags.all() else "none"
        share = f"{100 * flags.mean():.0f} %"
        yield (f"| {fusion} | {100 * loss:g} % | {np.median(error):.1e} | {error.max():.1e} | {share} | {trusted} |")


def draw(found: dict[tuple[str, float, int], Run]) -> None:
    """Left: more iterations do not mend what is lost. Right: which steps it was, and that they are flagged."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.2, 3.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    shades = {"plain": ["#fdae6b", "#f16913", "#d94801", "#8c2d04"], "relaxed": ["#9ecae1", "#4292c6", "#084594"]}
    for fusion, colours in shades.items():
        losses = [loss for name, loss in CURVES if name == fusion]
        for loss, colour in zip(losses, colours, strict=True):
            middle = [np.median(found[fusion, loss, r].error) for r in ROUNDS]
            style = "--" if not loss else "-"
            left.semilogy(ROUNDS, middle, style, color=colour, lw=1.4, label=f"{fusion}, {100 * loss:g} %")
    left.set(xlabel="iterations per step", ylabel="largest error of a component", title="Median over steps and nodes")
    left.legend(fontsize=7, ncols=2, loc="center right", bbox_to_anchor=(1, 0.62))

    loss = 0.001
    error, flags = found["plain", loss, TABLE]
    k = np.broadcast_to(np.arange(FIRST, STEPS), error.shape)
    right.semilogy(k[~flags], error[~flags], ".", color="#2b8a3e", label="plain, not flagged")
    right.semilogy(k[flags], error[flags], "x", color="#d94801", ms=4, label="plain, flagged")
    relaxed = found["relaxed", 0.1, TABLE].error
    right.semilogy(k.T, relaxed.T, color="#4292c6", lw=0.8, label=["relaxed, 10 %", *[None] * (len(relaxed) - 1)])
    right.set(xlabel="step", title=f"{TABLE} iterations, loss {100 * loss:g} %: every node's steps")
    right.legend(fontsize=7, ncols=3, loc="center", bbox_to_anchor=(0.5, 0.3))
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(FIGURE, dpi=90)


def main(argv: list[str]) -> int:
    """Run everything, print the table, write if asked."""
    found = {(fusion, loss, r): run(fusion, loss, r) for fusion, loss in CURVES for r in ROUNDS}
    text = "\n".join(rows(found)) + "\n"
    sys.stdout.write(text)
    if "--write" in argv:
        draw(found)
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(before + BEGIN + text + END + rest.split(END)[1], encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
