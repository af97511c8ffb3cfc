"""Every file in topologies/ loads with its method's real options and comes back from its resolved form."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from duio_mesh import schema
from duio_mesh.methods import METHODS
from duio_mesh.scenario import load_scenario, scenario_yaml
from duio_mesh.synthesis import options_of
from tests.conftest import TOPOLOGIES
from tests.scenario.same import same

FILES = sorted(TOPOLOGIES.glob("*.yaml"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_loads(path: Path, tmp_path: Path) -> None:
    s = load_scenario(path, options_of=options_of)
    (tmp_path / "scenario.yaml").write_text(scenario_yaml(s, {}))
    assert same(load_scenario(tmp_path / "scenario.yaml", options_of=options_of), s)
    assert path.read_text().startswith("# yaml-language-server: $schema=schema.json\n")


def test_names_are_unique() -> None:
    names = [load_scenario(path, options_of=options_of).name for path in FILES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", ["partitioned", "ring", "star", "six_state_ring"])
def test_what_seed_000_says_about_its_plants(name: str) -> None:
    """Assumption 1: at every node C_i times the unknown inputs has full column rank q_i."""
    s = load_scenario(TOPOLOGIES / f"{name}.yaml", options_of=options_of)
    unknown = [s.unknown(i) for i in s.nodes]
    assert [u.shape[1] for u in unknown] == ([2, 1, 2, 1, 1] if name == "six_state_ring" else [3, 3, 3, 4])
    for i, u in zip(s.nodes, unknown, strict=True):
        assert np.linalg.matrix_rank(s.nodes[i].C @ u) == np.linalg.matrix_rank(u) == u.shape[1]
    moduli = np.sort(np.abs(np.linalg.eigvals(s.plant.A)))
    if name == "six_state_ring":
        assert moduli[0] == pytest.approx(1.036, abs=1e-12)
        assert moduli[-1] < 1.126
    else:
        assert moduli[-1] == pytest.approx(1.0000333, abs=5e-8)


def test_heat_plant_is_the_heat_equation_of_its_walls() -> None:
    """A = expm(60 Ac) and B its exact zero-order hold in rooms 2, 5, 6, up to the printed digits (seed 000, 6.2)."""
    from scipy import linalg

    plant = load_scenario(TOPOLOGIES / "ring.yaml", options_of=options_of).plant
    walls = {(1, 2): 25, (1, 4): 5, (2, 3): 25, (2, 5): 15, (3, 6): 40, (4, 5): 15}
    walls |= {(4, 7): 40, (5, 6): 10, (5, 8): 35, (6, 9): 20, (7, 8): 10, (8, 9): 15}
    W = np.zeros((9, 9))
    for (i, j), rate in walls.items():
        W[i - 1, j - 1] = W[j - 1, i - 1] = 1e-4 * rate
    Ac = W - np.diag(W.sum(axis=1))
    block = linalg.expm(60 * np.block([[Ac, np.eye(9)], [np.zeros((9, 18))]]))
    assert np.max(np.abs(plant.A - block[:9, :9])) <= 0.5e-4 + 1e-12
    assert np.max(np.abs(plant.B - 0.1 * block[:9, 9:][:, [1, 4, 5]])) <= 0.5e-1 + 1e-12
    assert np.array_equal(plant.A, plant.A.T)


def test_schema_file_is_up_to_date() -> None:
    """When this fails: python -m duio_mesh.schema topologies/schema.json."""
    assert (TOPOLOGIES / "schema.json").read_text(encoding="utf-8") == schema.text()
    plants = json.loads((TOPOLOGIES / "plants" / "schema.json").read_text(encoding="utf-8"))
    assert plants["$ref"] == "../schema.json#/$defs/Plant"


def test_schema_names_every_method_and_every_option() -> None:
    written = json.loads(schema.text())
    observers = {
        o["properties"]["method"]["const"]: o["properties"] for o in written["properties"]["observer"]["oneOf"]
    }
    assert set(observers) == set(METHODS)
    for method, keys in observers.items():
        assert set(keys) == {"method", *options_of(method).model_fields}
    assert written["$defs"]["Plant"]["required"] == ["time", "A", "x0"]
    assert written["$defs"]["Term"]["oneOf"][0] == {"required": ["constant"]}
