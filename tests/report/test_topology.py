"""Where nodes are drawn: apart from each other, islands side by side, the same every time."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from synthetic import ring

from duio_mesh.report.entities import palette, spread
from duio_mesh.report.topology import positions

GRAPHS = {
    "ring": (list(range(1, 7)), ring(list(range(1, 7)))),
    "star": (list(range(1, 9)), tuple((1, j) for j in range(2, 9))),
    "path": ([3, 5, 9, 11], ((3, 5), (5, 9), (9, 11))),
    "islands": (list(range(1, 8)), ((1, 2), (2, 1), (3, 4), (4, 5), (5, 3), (6, 7))),
    "nobody talks": (list(range(1, 6)), ()),
    "one": ([4], ()),
    "complete": (list(range(5)), tuple(itertools.permutations(range(5), 2))),
    "many": (list(range(120)), (*ring(list(range(120))), (0, 60), (30, 90))),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_nodes_are_apart_and_always_in_the_same_place(name: str) -> None:
    ids, arcs = GRAPHS[name]
    at = positions(ids, arcs)
    assert sorted(at) == sorted(ids)
    points = np.array([at[i] for i in ids])
    assert np.isfinite(points).all()
    apart = [float(np.linalg.norm(a - b)) for a, b in itertools.combinations(points, 2)]
    assert min(apart, default=1.0) >= 1 - 1e-9
    assert positions(ids[::-1], arcs[::-1]) == at


def test_a_ring_is_a_circle_in_the_order_of_its_edges() -> None:
    order = [1, 3, 2, 5, 4]
    at = positions(order, ring(order))
    points = np.array([at[i] for i in order])
    radii = np.linalg.norm(points - points.mean(axis=0), axis=1)
    np.testing.assert_allclose(radii, radii[0])
    sides = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    np.testing.assert_allclose(sides, 1.0)
    assert points[0, 1] == points[:, 1].min(), "the smallest id is on top (y points down)"


def test_islands_do_not_overlap() -> None:
    ids, arcs = GRAPHS["islands"]
    at = positions(ids, arcs)
    boxes = [np.array([at[i] for i in island]) for island in ((1, 2), (3, 4, 5), (6, 7))]
    for a, b in itertools.combinations(boxes, 2):
        gap = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))
        assert gap.max() >= 1


@pytest.mark.parametrize("count", [1, 4, 8, 9, 16, 64])
def test_colours_can_be_told_apart(count: int) -> None:
    colours = palette(count)
    assert len(set(colours)) == count
    assert all(colour & 0xFF == 0xFF for colour in colours)
    parts = np.array([[colour >> shift & 0xFF for shift in (24, 16, 8)] for colour in colours])
    assert ((parts.max(axis=1) - parts.min(axis=1)) > 40).all(), "no grey: that is the truth"


def test_spread_keeps_the_first_and_the_last() -> None:
    assert spread(range(5), 9) == (0, 1, 2, 3, 4)
    assert spread(range(100), 4) == (0, 33, 66, 99)
    assert spread([7, 8, 9], 1) == (7,)
