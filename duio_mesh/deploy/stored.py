"""A design in a run folder: the very matrices that were designed, to be exported or gathered later and elsewhere.

scenario.yaml, certificate.json, nodes/node-<id>.spec and nodes/plant.spec: what `--dry-run --out` writes, and what
every run leaves.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from duio_mesh import synthesis
from duio_mesh.errors import RunError, ScenarioError
from duio_mesh.launcher import write_inputs
from duio_mesh.run_folder import RunFolder
from duio_mesh.scenario import load_scenario
from duio_mesh.spec import UNWIRED, NodeSpec, PlantSpec, read_spec, write_spec
from duio_mesh.synthesis.design import Design


def write_design(design: Design, out: Path | None) -> Path:
    """Write the design into a new folder, see ``RunFolder.create``; the folder."""
    folder = RunFolder.create(design.scenario.name, out)
    write_inputs(folder, design)
    write_spec(design.plant, folder.spec("plant"))
    for i, spec in design.nodes.items():
        write_spec(spec, folder.spec(f"node-{i}"))
    return folder.root


def read_design(root: Path) -> Design:
    """The design that a run folder holds. Raises ScenarioError when it holds none, or one that does not fit."""
    folder = RunFolder(root)
    missing = [name for name in ("scenario.yaml", "certificate.json", "nodes/plant.spec") if not (root / name).exists()]
    if missing:
        raise ScenarioError(
            [
                f"{root} holds no design ({', '.join(missing)} missing); "
                "python launch.py TOPOLOGY --dry-run --out DIR writes one"
            ]
        )
    scenario = load_scenario(root / "scenario.yaml", options_of=synthesis.options_of)
    try:
        plant = read_spec(folder.spec("plant"), PlantSpec)
        nodes = {i: read_spec(folder.spec(f"node-{i}"), NodeSpec) for i in scenario.nodes}
        certificate = json.loads((root / "certificate.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise RunError(f"{root} holds a design that cannot be read: {e}") from None
    return Design(
        scenario,
        replace(plant, wire=UNWIRED, output="", recorded=False),
        {i: replace(spec, wire=UNWIRED, output="", inputs="") for i, spec in nodes.items()},
        certificate,
    )
