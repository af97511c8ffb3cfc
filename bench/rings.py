"""The project's own runs that the benchmarks time."""

from __future__ import annotations

import copy
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from ruamel.yaml import YAML

import duio_mesh
from duio_mesh import launcher
from duio_mesh.synthesis.design import Design

TOPOLOGIES = Path(__file__).parent.parent / "topologies"


def admm_ring(count: int, steps: int, observer: Mapping[str, Any], **run: Any) -> Design:
    """A ring of ``count`` nodes with n = 6: the four sensors of admm_ring.yaml, again and again around it.

    Any four in a row, and so the whole ring (at least 3 nodes, with all four kinds from 4 on), reconstruct the state.
    """
    if count < 4:
        raise ValueError("a ring of the four kinds of sensors has at least four nodes")
    yaml = YAML(typ="safe")
    example = yaml.load(TOPOLOGIES / "admm_ring.yaml")
    kinds = [example["nodes"][i] for i in (1, 2, 4, 3)]  # in the order in which the example's ring joins them
    document = {
        "name": f"admm-ring-{count}",
        "plant": yaml.load(TOPOLOGIES / example["plant"]),
        "observer": {"method": "admm", **observer},
        "nodes": {i + 1: copy.deepcopy(kinds[i % 4]) for i in range(count)},
        "graph": {"edges": [[i + 1, (i + 1) % count + 1] for i in range(count)]},
        "run": {"steps": steps, "seed": 0, "convergence": {"rms_below": 1.0, "over_last": 0.5}, **run},
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring.yaml"
        yaml.dump(document, path)
        return duio_mesh.synthesise(duio_mesh.load_scenario(path))


def rounds_per_step(count: int) -> int:
    """Exchanges of a step of `finite_time` on a ring of ``count``: one per different nonzero eigenvalue."""
    return count // 2


def lmi_ring(steps: int) -> Design:
    """topologies/ring.yaml for so many steps: four nodes, n = 9, one round a step."""
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml", **{"run.steps": steps}))


def run_mesh(design: Design, *, record: bool = False, show: launcher.Show = launcher.ignore) -> Mapping[str, Any]:
    """Run as processes; the metrics."""
    with tempfile.TemporaryDirectory() as out:
        return launcher.run(design, Path(out) / "run", record=record, show=show).metrics
