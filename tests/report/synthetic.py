"""A made-up run that looks like a real one: nodes on a ring whose estimates converge to a known state down to noise."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from duio_mesh.arrays import Array
from duio_mesh.spec import RecorderSpec


def ring(ids: list[int]) -> tuple[tuple[int, int], ...]:
    """Both arcs of every edge of a ring."""
    pairs = list(zip(ids, ids[1:] + ids[:1], strict=True))
    return tuple(sorted(pairs + [(j, i) for i, j in pairs]))


def make_spec(path: Path, nodes: int = 4, n: int = 9, steps: int = 101, extra: int = 0, **changes: Any) -> RecorderSpec:
    """The spec of a recorder of a ring, writing to ``path``."""
    ids = list(range(1, nodes + 1))
    fields: dict[str, Any] = {
        "name": "synthetic ring",
        "n": n,
        "sizes": dict.fromkeys(ids, n + extra),
        "arcs": ring(ids) if nodes > 2 else ((1, 2), (2, 1)) if nodes == 2 else (),
        "step": 60.0,
        "steps": steps,
        "recording": str(path),
        "live": False,
        "description": "# Synthetic ring\n\nMade up for tests.",
        "truth": "",
        "estimates": {},
    }
    return RecorderSpec(**(fields | changes))


def make_rows(spec: RecorderSpec, noise: float = 0.3, seed: int = 0) -> tuple[Array, dict[int, Array]]:
    """The truth (K, n) and every node's rows (K, size)."""
    rng = np.random.default_rng(seed)
    k = np.arange(spec.steps)[:, None]
    phase = rng.uniform(0, 2 * np.pi, spec.n)
    truth = 18 + 3 * rng.standard_normal(spec.n) * np.exp(-k / 25) + np.sin(2 * np.pi * k / 100 + phase)
    rows = {}
    for i, size in spec.sizes.items():
        wrong = 12 * rng.standard_normal(spec.n) * np.exp(-k / rng.uniform(4, 9))
        measured = noise * rng.standard_normal((spec.steps, spec.n)) * rng.uniform(0.5, 1.2)
        other = np.sin(2 * np.pi * k / 40) + 0.05 * rng.standard_normal((spec.steps, size - spec.n))
        rows[i] = np.hstack([truth + wrong + measured, other])
    return truth, rows


def read_series(path: Path, entity: str, timeline: str = "step") -> tuple[NDArray[np.int64], Array]:
    """All rows of a scalar entity in the order of time: (times, values)."""
    times, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    column = "Scalars:scalars"
    for chunk in RrdReader(path).stream().filter(content=entity, has_timeline=timeline, components=column):
        batch = chunk.to_record_batch()
        scalars = batch.column(column)
        times.append(batch.column(timeline).cast(pa.int64()).to_numpy()[np.asarray(pc.is_valid(scalars))])
        values.append(pc.list_flatten(scalars).to_numpy(zero_copy_only=False))
    t, v = np.concatenate(times), np.concatenate(values)
    order = np.argsort(t, kind="stable")
    return t[order], v[order]


def read_texts(path: Path, entity: str, column: str) -> list[tuple[int, str]]:
    """All rows of a text component: (step, text)."""
    found = []
    for chunk in RrdReader(path).stream().filter(content=entity, has_timeline="step", components=column):
        batch = chunk.to_record_batch()
        steps = batch.column("step").cast(pa.int64()).to_pylist()
        found += [(k, texts[0]) for k, texts in zip(steps, batch.column(column).to_pylist(), strict=True) if texts]
    return sorted(found)


def entities(path: Path) -> Mapping[str, int]:
    """Entity path -> number of chunks."""
    counts: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        counts[chunk.entity_path] = counts.get(chunk.entity_path, 0) + 1
    return counts
