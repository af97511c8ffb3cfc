"""`resume(x, y, u)`: an observer that begins after a step goes on as one would that had been at x all along."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from duio_mesh.arrays import Array
from duio_mesh.dynamics import Plant
from duio_mesh.observers import make_observer
from duio_mesh.observers.base import Observer
from duio_mesh.synthesis.design import Design
from tests.faults.test_oracle import design_of

NOISELESS: dict[str, Any] = {"plant.noise": 0}
BEGIN, AFTER = 60, 8


def samples(design: Design) -> Iterator[tuple[int, Array, dict[int, tuple[Array, Array]]]]:
    """(k, x(k), {node: (y, u)}) up to step BEGIN + AFTER."""
    plant = Plant(design.plant)
    for k in range(BEGIN + AFTER + 1):
        data = plant.sample()
        yield k, plant.x.copy(), {i: (data[i][: s.p], data[i][s.p :]) for i, s in design.nodes.items()}
        plant.advance()


def alone(observer: Observer, y: Array, u: Array) -> Array:
    """The estimate of a step in which no neighbour is heard."""
    observer.sample(y, u)
    for r in range(observer.rounds):
        observer.exchange(r, {})
    return observer.estimate().state.copy()


@pytest.mark.parametrize(
    ("name", "changes", "apart"),
    [
        ("ring", NOISELESS, 1e-13),
        ("six_state_ring", {}, 1e-13),
        ("augmented_example9", {}, 1e-13),
        ("augmented_six_state", {}, 1e-13),
        ("augmented_directed", {}, 1e-13),
        ("geometric_ring", {}, 1e-13),  # with three lags of samples, of which it has seen two
        ("reduced_order_kundur8", {}, 1e-4),  # eta+ and the slope cannot be told by others: they begin anew
    ],
)
def test_it_equals_the_observer_whose_estimate_it_was_given(name: str, changes: dict[str, Any], apart: float) -> None:
    """One runs from step 0 on without neighbours, the other takes its estimate over."""
    design = design_of(name, None, **changes)
    old, new, fresh = ({i: make_observer(s) for i, s in design.nodes.items()} for _ in range(3))
    differs = False
    for k, _, data in samples(design):
        for i, (y, u) in data.items():
            known = alone(old[i], y, u)
            if k == BEGIN:
                new[i].resume(known.copy(), y, u)
            elif k > BEGIN:
                found, begun = alone(new[i], y, u), alone(fresh[i], y, u)
                assert np.abs(found - known).max() <= apart * (1 + np.abs(known).max()), (i, k)
                differs |= bool(np.abs(begun - known).max() > 1e3 * apart)
    assert differs  # from one that begins with nothing


@pytest.mark.parametrize(
    ("name", "changes"), [("ring", NOISELESS), ("six_state_ring", NOISELESS), ("augmented_example9", {})]
)
def test_the_error_goes_on_by_the_error_dynamics(name: str, changes: dict[str, Any]) -> None:
    """Without neighbours e(k+1) = N e(k) whatever the unknown input does; 0 stays 0."""
    design, rng = design_of(name, None, **changes), np.random.default_rng(7)
    exact, off = ({i: make_observer(s) for i, s in design.nodes.items()} for _ in range(2))
    e = {i: rng.standard_normal(s.n) for i, s in design.nodes.items()}
    for k, x, data in samples(design):
        for i, (y, u) in data.items():
            if k == BEGIN:
                exact[i].resume(x, y, u)
                off[i].resume(x + e[i], y, u)
            elif k > BEGIN:
                e[i] = design.nodes[i].matrices["N"] @ e[i]
                scale = 1e-11 * (1 + np.abs(x).max())
                assert np.abs(alone(exact[i], y, u) - x).max() < scale, (i, k)
                assert np.abs(alone(off[i], y, u) - x - e[i]).max() < scale * (1 + np.abs(e[i]).max()), (i, k)


def test_finite_time_fusion_is_exact_at_once() -> None:
    """All begin from the true state: what each can follow alone is right, so the fusion is. From zero it is not."""
    design = design_of("finite_time_ring", None, **{"observer.setup": "global"})
    told, zero = ({i: make_observer(s) for i, s in design.nodes.items()} for _ in range(2))
    for k, x, data in samples(design):
        if k == BEGIN:
            for i, (y, u) in data.items():
                told[i].resume(x, y, u)
        elif k > BEGIN:
            assert np.abs(together(design, told, data) - x).max() < 1e-10 * (1 + np.abs(x).max()), k
            assert np.abs(together(design, zero, data) - x).max() > 1e-6 * (1 + np.abs(x).max()), k


def together(design: Design, nodes: dict[int, Observer], data: dict[int, tuple[Array, Array]]) -> Array:
    """(N, n) estimates of one step in which everybody is heard."""
    for i, (y, u) in data.items():
        nodes[i].sample(y, u)
    for r in range(nodes[1].rounds):
        sent = {i: node.message(r).copy() for i, node in nodes.items()}
        for i, node in nodes.items():
            node.exchange(r, {j: sent[j] for j in sorted(design.nodes[i].hears)})
    return np.stack([node.estimate().state for node in nodes.values()])
