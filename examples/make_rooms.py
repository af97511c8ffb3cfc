"""Writes examples/rooms.csv: what the sensors of topologies/ring.yaml measure in its simulated building.

python examples/make_rooms.py > examples/rooms.csv
"""

import csv
import sys
from pathlib import Path

import duio_mesh
from duio_mesh.dynamics import Plant

scenario = duio_mesh.load_scenario(Path(__file__).parent.parent / "topologies" / "ring.yaml")
design = duio_mesh.synthesise(scenario)
columns = []
for i, node in scenario.nodes.items():
    columns += [f"{i}.y.room{row.argmax() + 1}" for row in node.C]
    columns += [f"{i}.u.{name}" for name in scenario.plant.inputs if name in node.knows]
table = csv.writer(sys.stdout, lineterminator="\n")
table.writerow(columns)
plant = Plant(design.plant)
for _ in range(scenario.run.steps):
    table.writerow([f"{value:.4f}" for numbers in plant.sample().values() for value in numbers])
    plant.advance()
