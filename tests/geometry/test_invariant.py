"""W*, S*, W*_g, friends, zeros: planted in Morse's form, against Rosenbrock's pencil and SLICOT, and on the papers."""

from __future__ import annotations

import numpy as np
import pytest
import slycot
from hypothesis import given, settings
from hypothesis import strategies as st
from papers import GEO_A, GEO_B, GEO_C, GEO_UNKNOWN, SIX_A, SIX_B, SIX_C, SIX_UNKNOWN
from planted import Planted, morse
from scipy import linalg
from scipy.optimize import linear_sum_assignment

from duio_mesh.geometry import (
    GeometryError,
    complement,
    friend,
    gap,
    infimal_invariant,
    infimal_unobservability,
    kernel,
    quotient,
    stable_abscissa,
    stable_radius,
    unknown_input_structure,
    unobservable_subspace,
)

GOOD = [-0.5, 0.2, 0.7j, -0.3 + 0.5j, 0.6]
BAD = [1.2, -1.5, 1j, 0.8 + 0.9j, 1.0]


@st.composite
def systems(draw: st.DrawFn) -> Planted:
    """Up to 3 zeros on each side of the circle, 3 chains, and free and unseen parts: n up to about 18."""

    def some(values: list[complex]) -> list[complex]:
        return draw(st.lists(st.sampled_from(values), max_size=2, unique=True))

    good, bad = some(GOOD), some(BAD)
    chains = draw(st.lists(st.integers(1, 3), max_size=3))
    free, seen = draw(st.integers(0, 2)), draw(st.integers(0, 3))
    if not (good or bad or chains or free or seen):
        seen = 1
    return morse(np.random.default_rng(draw(st.integers(0, 2**32 - 1))), good, bad, chains, free, seen)


def distance(found: np.ndarray, wanted: np.ndarray) -> float:
    """The largest distance in the best matching of two spectra."""
    assert len(found) == len(wanted)
    apart = np.abs(np.subtract.outer(found, wanted))
    return float(apart[linear_sum_assignment(apart)].max(initial=0.0))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(systems())
def test_finds_the_planted_structure(s: Planted) -> None:
    found = unknown_input_structure(s.C, s.A, s.B, stable_radius())
    assert [V.shape[1] for V in (found.W, found.S, found.Wg)] == [V.shape[1] for V in (s.W, s.S, s.Wg)]
    assert gap(found.W, s.W) < 1e-9
    assert gap(found.S, s.S) < 1e-9
    assert gap(found.Wg, s.Wg) < 1e-9
    assert distance(found.zeros, s.zeros) < 1e-8
    assert len(found.bad) == s.bad
    assert found.margin.dropped < 1e-11
    assert found.margin.kept > 1e-5


@settings(max_examples=100, deadline=None, derandomize=True)
@given(systems(), st.integers(0, 2**32 - 1))
def test_defining_properties(s: Planted, seed: int) -> None:
    """One friend for the whole chain; zeros do not depend on the friend; S* is an unobservability subspace."""
    found = unknown_input_structure(s.C, s.A, s.B, stable_radius())
    n, size = len(s.A), np.linalg.norm(s.A, 2) * max(1.0, np.abs(found.L).max(initial=0.0))
    for V in (found.W, found.Wg, found.S):
        assert np.abs(quotient(V) @ (s.A + found.L @ s.C) @ V).max(initial=0.0) < 1e-9 * size
    # another friend: add anything into W*, and anything that only listens to outputs which vanish on W*
    rng = np.random.default_rng(seed)
    H = kernel((s.C @ found.W).T, scale=1.0).T
    other = found.L + found.W @ rng.standard_normal((found.W.shape[1], len(s.C)))
    other = other + rng.standard_normal((n, len(H))) @ H
    assert np.abs(quotient(found.W) @ (s.A + other @ s.C) @ found.W).max(initial=0.0) < 1e-8 * size
    Q = found.S @ complement(found.S.T @ found.W)
    assert distance(np.linalg.eigvals(Q.T @ (s.A + other @ s.C) @ Q), found.zeros) < 1e-7
    # S* = <Ker HC | A + LC> (seed 003, (2)) for every friend
    assert gap(unobservable_subspace(H @ s.C, s.A + other @ s.C), found.S) < 1e-7
    assert gap(infimal_invariant(s.C, s.A, s.B), found.W) < 1e-12
    assert gap(infimal_unobservability(s.C, s.A, found.W), found.S) < 1e-12


@settings(max_examples=100, deadline=None, derandomize=True)
@given(systems())
def test_zeros_are_where_the_rosenbrock_pencil_drops_rank(s: Planted) -> None:
    def pencil(point: complex) -> np.ndarray:
        zero = np.zeros((len(s.C), s.B.shape[1]))
        return np.block([[s.A - point * np.eye(len(s.A)), s.B], [s.C, zero]])

    def values(point: complex) -> np.ndarray:
        return np.linalg.svd(pencil(point), compute_uv=False)

    found = unknown_input_structure(s.C, s.A, s.B, stable_radius())
    normal_rank = np.linalg.matrix_rank(pencil(0.1234 + 4.321j), tol=1e-8)
    for zero in found.zeros:
        assert values(zero)[normal_rank - 1] < 1e-8
    assert values(3.1 - 2.2j)[normal_rank - 1] > 1e-6


@settings(max_examples=100, deadline=None, derandomize=True)
@given(systems())
def test_zeros_agree_with_slicot(s: Planted) -> None:
    n, m, p = len(s.A), s.B.shape[1], len(s.C)
    found = unknown_input_structure(s.C, s.A, s.B, stable_radius())
    if not m or not p:
        return  # SLICOT counts decoupling zeros its own way when there is no input or output
    nu, *_, Af, Bf = slycot.ab08nd(n, m, p, s.A, s.B, s.C, np.zeros((p, m)), tol=1e-9)
    zeros = np.linalg.eigvals(np.linalg.solve(Bf[:nu, :nu], Af[:nu, :nu])) if nu else np.zeros(0)
    assert distance(found.zeros, zeros) < 1e-6


def test_seed_002_dimensions_and_zeros() -> None:
    """Section 4 with C_g = {|z| < 0.99}; the paper's own dimensions need a bound between 0.9885 and 0.9999."""
    found = {
        i: unknown_input_structure(C, SIX_A, SIX_B[:, SIX_UNKNOWN[i]], stable_radius(0.99)) for i, C in SIX_C.items()
    }
    dims = [tuple(V.shape[1] for V in (s.W, s.S, s.Wg)) for s in found.values()]
    assert dims == [(6, 6, 6), (2, 6, 5), (5, 6, 5), (1, 6, 3)]
    expected = {
        1: ([], []),
        2: ([0.99991, 0.985 + 0.1724j, 0.985 - 0.1724j], [-0.0152]),
        3: ([], [-0.9804]),
        4: ([0.9945 + 0.1043j, 0.9945 - 0.1043j], [-0.9885, 0.9453 + 0.1061j, 0.9453 - 0.1061j]),
    }
    for i, (bad, good) in expected.items():
        assert distance(found[i].bad, np.array(bad)) < 1e-4
        assert distance(found[i].zeros[len(bad) :], np.array(good)) < 1e-4
    literal = [unknown_input_structure(C, SIX_A, SIX_B[:, SIX_UNKNOWN[i]], stable_radius()) for i, C in SIX_C.items()]
    assert [s.Wg.shape[1] for s in literal] == [6, 2, 5, 1]  # the trap: rounding put the unit-circle zeros inside
    tight = [unknown_input_structure(C, SIX_A, SIX_B[:, SIX_UNKNOWN[i]], stable_radius(0.97)) for i, C in SIX_C.items()]
    assert [s.Wg.shape[1] for s in tight] == [6, 5, 6, 4]


@pytest.mark.parametrize("rtol", [1e-12, 1e-9, 1e-6, 1e-3])
def test_seed_002_does_not_depend_on_the_tolerance(rtol: float) -> None:
    dims = []
    for i, C in SIX_C.items():
        s = unknown_input_structure(C, SIX_A, SIX_B[:, SIX_UNKNOWN[i]], stable_radius(0.99), rtol)
        dims.append((s.W.shape[1], s.S.shape[1], s.Wg.shape[1]))
    assert dims == [(6, 6, 6), (2, 6, 5), (5, 6, 5), (1, 6, 3)]


def test_seed_003_node_table() -> None:
    root12, root6 = 2j * np.sqrt(3), 1j * np.sqrt(6)
    expected = {
        1: ((1, 4, 2, 3), [-2, root12, -root12]),
        2: ((2, 6, 3, 5), [-2, 0, root6, -root6]),
        3: ((1, 4, 3, 4), [0, root12, -root12]),
        4: ((5, 6, 0, 5), [-3]),
    }
    planes = {
        1: np.eye(6)[:, [2, 4, 5]],
        2: complement(np.array([[2.0, 2, -1, 0, 2, 3]]).T / np.sqrt(22)),
        3: np.eye(6)[:, [0, 1, 4, 5]],
        4: np.eye(6)[:, 1:],
    }
    for i, (dims, zeros) in expected.items():
        found = unknown_input_structure(GEO_C[i], GEO_A, GEO_B[:, GEO_UNKNOWN[i]], stable_abscissa())
        assert tuple(V.shape[1] for V in (found.W, found.S, found.V, found.Wg)) == dims
        assert distance(found.zeros, np.array(zeros)) < 1e-12
        assert gap(found.Wg, planes[i]) < 1e-13


def test_marginal_zeros_are_bad_by_margin_not_by_luck() -> None:
    """Computed zeros on the axis have real parts of either sign; the margin of 1e-6 decides, not the rounding."""
    counts = []
    for seed in range(100):
        s = morse(np.random.default_rng(seed), [-1.0], [2j, 0.0], [2], 0, 1)
        found = unknown_input_structure(s.C, s.A, s.B, stable_abscissa())
        counts.append(len(found.bad))
    assert counts == [3] * 100


@pytest.mark.parametrize("seed", [87, 106, 152])
def test_data_errors_above_the_tolerance(seed: int) -> None:
    """The recursion for S* need not settle when rtol equals the data errors; far above them it is right."""
    rng = np.random.default_rng(seed)
    s = morse(rng, [0.3], [1.5], [2, 2, 3], 1, 2)
    A = s.A + 1e-5 * rng.standard_normal(s.A.shape)
    with pytest.raises(GeometryError, match=r"did not settle within 28 steps.*undecided between 1e-05 and rounding"):
        unknown_input_structure(s.C, A, s.B, stable_radius(), rtol=1e-5)
    found = unknown_input_structure(s.C, A, s.B, stable_radius(), rtol=1e-3)
    assert gap(found.Wg, s.Wg) < 1e-3


def test_friend_refuses_a_subspace_that_is_not_invariant() -> None:
    A, C = np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[0.0, 1.0]])
    with pytest.raises(GeometryError, match=r"not \(C,A\)-invariant"):
        friend(C, A, np.array([[1.0], [0.0]]))


def test_extremes() -> None:
    A = np.diag([0.5, 2.0])
    no_input = unknown_input_structure(np.eye(2), A, np.zeros((2, 0)), stable_radius())
    assert no_input.Wg.shape == (2, 0)
    no_output = unknown_input_structure(np.zeros((0, 2)), A, np.zeros((2, 1)), stable_radius())
    assert no_output.W.shape == (2, 0)
    assert no_output.S.shape == (2, 2)
    assert no_output.Wg.shape == (2, 1)
    everything = unknown_input_structure(np.zeros((1, 2)), A, np.eye(2), stable_radius())
    assert everything.Wg.shape == (2, 2)
    # a tiny input column counts as much as a large one: columns have units of their own
    small = unknown_input_structure(np.eye(2), A, np.array([[1e-8, 0.0], [0.0, 1e8]]), stable_radius())
    assert small.W.shape == (2, 2)
    assert unknown_input_structure(np.eye(2), A, np.array([[1e-4, 0], [0, 1.0]]), stable_radius()).W.shape == (2, 2)


@pytest.mark.parametrize("k", [8, 10])
@pytest.mark.parametrize("driven", [0, 1])
def test_a_chain_of_masses_settles(k: int, driven: int) -> None:
    """Seen at one end: every mode shows, but the last of 2 k directions by little more than rounding.

    ``driven``: beside it a state that an unknown input drives and a sensor sees, so that W* is not 0.
    """
    K, eye, zero = 2 * np.eye(k) - np.eye(k, k=1) - np.eye(k, k=-1), np.eye(k), np.zeros((k, k))
    chain = linalg.expm(0.2 * np.block([[zero, eye], [-K, -0.1 * eye]]))
    A, ends = linalg.block_diag(chain, 0.5 * np.eye(driven)), np.eye(2 * k + driven)
    found = unknown_input_structure(ends[[0, -1][: 1 + driven]], A, ends[:, 2 * k :], stable_radius())
    assert found.W.shape[1] == driven
    assert found.bad.size == 0
