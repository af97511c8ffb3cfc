"""Without the launcher: the same specs, each process started by its own command, as a container would."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import duio_mesh
from duio_mesh.journal import map_rows
from duio_mesh.spec import NodeSpec, PlantSpec, write_spec
from duio_mesh.wiring import Wiring
from tests.conftest import TOPOLOGIES

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]


SLOW = """
from duio_mesh import node
from duio_mesh.mesh import Mesh

meet = Mesh.meet

def late(mesh, timeout=None):
    with mesh._news:  # everything is declared; is anybody done and gone before we look for them?
        mesh._news.wait_for(lambda: mesh._seen - mesh._here, 1.5)
    meet(mesh, timeout)

Mesh.meet = late
node.main(node.NodeSpec, node.run)
"""


def start(specs: dict[str, NodeSpec | PlantSpec], wiring: Wiring, slow: str = "") -> dict[str, subprocess.Popen[str]]:
    """Every process by its own command; the one called ``slow`` is late for the start barrier."""
    wires, running = wiring.wires(), {}
    for who, spec in specs.items():
        write_spec(replace(spec, wire=wires[who], output=f"{who}.f64"), Path(f"{who}.spec"))
        entry = ["-c", SLOW] if who == slow else ["-m", f"duio_mesh.{who.split('-')[0]}"]
        command = [sys.executable, *entry, "--spec", f"{who}.spec"]
        running[who] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    return running


def test_nobody_is_done_before_everybody_has_started() -> None:
    """Where all messages are lost a node needs no neighbour: it must not be gone when a slow one looks for it."""
    faults = {"links": [{"loss": 1.0}]}
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml", **{"run.steps": 40}, faults=faults)
    design = duio_mesh.synthesise(scenario)
    wiring = Wiring(design, Path("keys"), record=False)
    specs: dict[str, NodeSpec | PlantSpec] = {f"node-{i}": spec for i, spec in design.nodes.items()}
    running = start(specs | {"plant": design.plant}, wiring, slow="node-4")
    said = {who: process.communicate(timeout=60)[0] for who, process in running.items()}
    wiring.release()
    assert {who: process.returncode for who, process in running.items()} == dict.fromkeys(running, 0), said


def test_processes_started_by_hand_in_any_order_equal_the_oracle() -> None:
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "partitioned.yaml", **{"run.steps": 300})
    design = duio_mesh.synthesise(scenario)
    wiring = Wiring(design, Path("keys"), record=False)
    specs: dict[str, NodeSpec | PlantSpec] = {f"node-{i}": spec for i, spec in design.nodes.items()}
    specs["plant"] = design.plant  # the last to be started: the nodes wait for it
    running = start(specs, wiring)
    said = {who: process.communicate(timeout=60)[0] for who, process in running.items()}
    wiring.release()
    assert {who: process.returncode for who, process in running.items()} == dict.fromkeys(specs, 0), said
    assert all('"event": "done"' in text for text in said.values())
    trace = duio_mesh.simulate(design)
    assert map_rows("plant.f64", 9).tobytes() == trace.x.tobytes()
    for at, i in enumerate(design.nodes):
        assert map_rows(f"node-{i}.f64", 9).tobytes() == trace.xhat[at].tobytes()
