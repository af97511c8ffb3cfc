"""A plant in other units of its states is the same plant: designs exist, and estimate as well (synthesis/units.py)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from duio_mesh import load_scenario, simulate, synthesise
from duio_mesh.arrays import Array
from duio_mesh.errors import DesignError
from duio_mesh.scenario.model import OpenLoop, Scenario
from duio_mesh.synthesis import units as module
from duio_mesh.synthesis.contingency import contingency
from duio_mesh.synthesis.units import in_units, state_units
from tests.conftest import TOPOLOGIES

EXAMPLES = sorted(path.stem for path in TOPOLOGIES.glob("*.yaml"))
REFUSED = [  # in units so many decades apart there is no design in the file's own
    ("ring", 1, 4),
    ("partitioned", 2, 8),
    ("augmented_example9", 1, 8),
    ("augmented_six_state", 3, 8),
    ("admm_star", 1, 4),
    ("relaxed_ring", 5, 4),
    ("finite_time_ring", 3, 8),
    ("geometric_ring", 1, 4),
    ("geometric_ring", 3, 8),
    ("geometric_centralised", 1, 8),
    ("reduced_order_kundur8", 1, 10),
]


def rest(name: str) -> Scenario:
    """The example without feedback, from the zero state: what a design looks at has to be changed in every unit."""
    scenario = load_scenario(TOPOLOGIES / f"{name}.yaml", **{"run.steps": 1000})
    plant = scenario.plant
    control = plant.control if isinstance(plant.control, OpenLoop) else OpenLoop(((),) * plant.B.shape[1])
    return replace(scenario, plant=replace(plant, control=control, x0=np.ones(plant.n)))


def factors(n: int, seed: int, decades: float) -> Array:
    """(n,) powers of two, so that nothing is rounded."""
    rng = np.random.default_rng(seed)
    found: Array = np.exp2(np.round(rng.uniform(-decades / 2, decades / 2, n) * np.log2(10)))
    return found


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_units_found_do_not_depend_on_the_units_given(name: str) -> None:
    scenario = rest(name)
    a, b = (factors(scenario.plant.n, seed, 10) for seed in (1, 2))
    one, other = (np.log2(state_units(in_units(scenario, s)) * s) for s in (a, b))
    assert np.ptp(one - other) <= 2  # each is rounded to a power of two, with its mean


def test_rounding_beside_the_entries_says_nothing() -> None:
    scenario = rest("geometric_ring")
    s = factors(6, 3, 8)
    noise = 1e-16 * np.random.default_rng(0).standard_normal((6, 6)) * np.abs(scenario.plant.A).max()
    noisy = replace(scenario, plant=replace(scenario.plant, A=scenario.plant.A + noise * (scenario.plant.A == 0)))
    assert np.array_equal(state_units(in_units(noisy, s)), state_units(in_units(scenario, s)))


@pytest.mark.parametrize(("name", "seed", "decades"), REFUSED)
def test_estimates_are_as_good_in_any_units(
    monkeypatch: pytest.MonkeyPatch, name: str, seed: int, decades: float
) -> None:
    scenario = rest(name)
    s = factors(scenario.plant.n, seed, decades)
    design = synthesise(in_units(scenario, s))
    assert np.ptp(np.log2(np.array(design.certificate["state_units"]) * s)) <= 6  # near those of the example
    trace, own = simulate(design), simulate(synthesise(scenario))
    np.testing.assert_allclose(trace.x * s, own.x, rtol=1e-6, atol=1e-9)
    error, before = (np.abs(t.xhat - t.x)[:, -20:] for t in (trace, own))
    assert (error * s).max() < 20 * before.max()  # the geometric one's floor depends on the coordinates of its coupling
    monkeypatch.setattr(module, "state_units", lambda _: np.ones(len(s)))
    with pytest.raises(DesignError):
        synthesise(in_units(scenario, s))


def test_a_contingency_is_judged_as_in_the_design() -> None:
    scenario = rest("admm_star")
    judged = []
    for s in (np.ones(6), factors(6, 1, 8)):
        found = contingency(synthesise(in_units(scenario, s)))
        assert found["nominal"] == pytest.approx(0.912, abs=0.01)
        judged.append([(case["lost"], case["failing"], case["reconstructs"]) for case in found["cases"]])
    assert judged[0] == judged[1]
    assert any(good for *_, good in judged[0])


def test_the_certificate_predicts_errors_in_the_file_s_units() -> None:
    scenario = rest("ring")
    s = factors(9, 1, 4)
    design = synthesise(in_units(scenario, s))
    trace = simulate(design)
    measured = np.sqrt(np.mean((trace.xhat - trace.x)[:, 500:] ** 2, axis=(1, 2)))
    predicted = [node["predicted_rms"] for node in design.certificate["nodes"].values()]
    assert measured == pytest.approx(predicted, rel=0.3)


def test_gains_that_the_file_holds_are_in_its_units() -> None:
    path = TOPOLOGIES / "augmented_example9.yaml"
    sizes = {i: len(node.C) for i, node in load_scenario(path).nodes.items()}
    given = [{"node": i, "F": np.zeros((3, p)).tolist(), "K": np.zeros((3, 3)).tolist()} for i, p in sizes.items()]
    scenario = load_scenario(path, **{"observer.gains": {"given": given}})
    with pytest.raises(DesignError, match="spectral radius of the whole error system") as own:
        synthesise(in_units(scenario, factors(3, 1, 8)))
    assert "unit of its own" not in str(own.value)
