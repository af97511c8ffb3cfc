"""Measurements that share a machine: every contender once per repetition, in shuffled order, and the ratios' table."""

from __future__ import annotations

import os
import platform
import random
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeAlias


class Missing(Exception):
    """A contender that cannot run here; the text says why."""


Contenders: TypeAlias = Mapping[str, Callable[[], float]]
Results: TypeAlias = dict[str, "list[float] | str"]
"""Contender -> one value per repetition, or why there is none."""


def interleaved(contenders: Contenders, repeat: int, seed: int = 0) -> Results:
    """Run everybody ``repeat`` times; a contender that raises Missing once is not asked again."""
    shuffled, results = random.Random(seed), Results()
    for _ in range(repeat):
        order = [name for name in contenders if not isinstance(results.get(name), str)]
        shuffled.shuffle(order)
        for name in order:
            values = results.setdefault(name, [])
            assert isinstance(values, list)
            try:
                values.append(contenders[name]())
            except Missing as e:
                results[name] = str(e)
    return {name: results[name] for name in contenders}


def table(title: str, results: Results, reference: str, unit: str, number: str = "{:.0f}") -> str:
    """A markdown table: the median, and the median of the ratios to ``reference`` [least - greatest].

    A ratio is taken within a repetition, in which the two ran a few seconds apart.
    """
    lines = [f"| {title} | {unit} | ratio |", "|---|---|---|"]
    base = results[reference]
    for name, values in results.items():
        if isinstance(values, str):
            lines.append(f"| {name} | - | {values} |")
            continue
        ratio = "-"
        if isinstance(base, list):
            ratios = [a / b for a, b in zip(values, base, strict=True)]
            middle, least, most = (_short(x) for x in (statistics.median(ratios), min(ratios), max(ratios)))
            ratio = f"{middle} [{least} - {most}]"
        lines.append(f"| {name} | {number.format(statistics.median(values))} | {ratio} |")
    return "\n".join(lines) + "\n"


def _short(ratio: float) -> str:
    return f"{ratio:.2f}" if ratio >= 0.1 else f"{ratio:.2g}"


def machine() -> str:
    """One line for the head of a table: processor, cores, load, versions, date."""
    names = [s.split(":")[1].strip() for s in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in s]
    day = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    load = "load average before the run " + ", ".join(f"{x:.1f}" for x in os.getloadavg())
    kernel = f"Linux {platform.release().split('-')[0]}, Python {platform.python_version()}"
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores, {kernel}, {day}; {load}"
