"""Placed and stabilised filters on X/W*_g: the spectra that come out, and the refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from papers import GEO_A, GEO_B, GEO_C, GEO_UNKNOWN, SIX_A, SIX_B, SIX_C, SIX_UNKNOWN
from planted import morse
from scipy import signal
from scipy.optimize import linear_sum_assignment

from duio_mesh.geometry import (
    GeometryError,
    Stability,
    place,
    reduced_observer,
    stabilise,
    stable_abscissa,
    stable_radius,
    unknown_input_structure,
)


def distance(found: np.ndarray, wanted: np.ndarray) -> float:
    assert len(found) == len(wanted)
    apart = np.abs(np.subtract.outer(found, np.asarray(wanted)))
    return float(apart[linear_sum_assignment(apart)].max(initial=0.0))


REAL, PAIR = [0.1, -0.2, 0.35, -0.5, 0.6, -0.75], [0.3 + 0.4j, 0.3 - 0.4j]


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 7), st.integers(1, 3), st.booleans(), st.integers(0, 2**32 - 1))
def test_place_reaches_the_poles(n: int, p: int, keep_some: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, C = rng.standard_normal((n, n)), rng.standard_normal((p, n))
    poles = np.array(REAL[:n] if n < 3 else REAL[: n - 2] + PAIR)
    if keep_some:  # a pole that A has already
        values = np.linalg.eigvals(A)
        real = values[values.imag == 0].real
        if real.size:
            poles[0] = real[0]
    M = place(C, A, poles)
    assert distance(np.linalg.eigvals(A + M @ C), poles) < 1e-4


def test_one_output_has_one_answer() -> None:
    """Ackermann's formula, as scipy computes it for a single channel."""
    rng = np.random.default_rng(3)
    A, C = rng.standard_normal((4, 4)), rng.standard_normal((1, 4))
    poles = [-1.0, -2.0, -1.5 + 1j, -1.5 - 1j]
    expected = -signal.place_poles(A.T, C.T, poles).gain_matrix.T
    assert place(C, A, poles) == pytest.approx(expected, rel=1e-7)


def test_repeated_poles_and_nothing_to_do() -> None:
    rng = np.random.default_rng(1)
    A, C = rng.standard_normal((3, 3)), rng.standard_normal((1, 3))
    M = place(C, A, [0.5, 0.5, 0.5])
    assert np.poly(A + M @ C) == pytest.approx(np.poly([0.5] * 3), abs=1e-10)
    assert not place(C, np.diag([0.1, 0.2, 0.3]), [0.3, 0.1, 0.2]).any()  # already there: no gain at all
    assert place(np.zeros((0, 0)), np.zeros((0, 0)), []).shape == (0, 0)


@pytest.mark.parametrize(
    ("C", "A", "poles", "words"),
    [
        (np.eye(2), np.eye(2), [0.1], "2 poles are needed"),
        (np.eye(2), np.eye(2), [0.1, 0.2j], "conjugate pairs"),
        (np.zeros((1, 2)), np.eye(2), [0.1, 0.2], "no output sees"),
        (np.zeros((0, 2)), np.eye(2), [0.1, 0.2], "no output sees"),
        (np.array([[1.0, 0.0]]), np.diag([1.0, 2.0]), [0.1, 0.2], "no output injection"),  # 2 is not observable
        (np.array([[1.0, 1e-9]]), np.diag([1.0, 2.0]), [0.1, 0.2], "no output injection of norm below 2.0e"),
    ],
)
def test_place_refuses(C: np.ndarray, A: np.ndarray, poles: list, words: str) -> None:
    with pytest.raises(GeometryError, match=words):
        place(C, A, poles)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(1, 8), st.integers(1, 3), st.floats(0.3, 1.0), st.integers(0, 2**32 - 1))
def test_stabilise_enters_the_region(n: int, p: int, bound: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, C = 1.5 * rng.standard_normal((n, n)) / np.sqrt(n), rng.standard_normal((p, n))
    M = stabilise(C, A, stable_radius(bound))
    assert np.abs(np.linalg.eigvals(A + M @ C)).max() < bound
    M = stabilise(C, A, stable_abscissa(-bound))
    assert np.linalg.eigvals(A + M @ C).real.max() < -bound


def test_stabilise_refuses_what_it_cannot_see() -> None:
    with pytest.raises(GeometryError, match=r"\|lambda\| < 1"):
        stabilise(np.array([[1.0, 0.0]]), np.diag([0.5, 1.5]), stable_radius(1.0))


def test_stabilise_says_which_of_two_things_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A gain that is too large for the limit is not a wrong spectrum; and an integrator needs a gain of 1, not 0."""
    C = np.eye(1)
    assert stabilise(C, np.zeros((1, 1)), stable_abscissa()) == pytest.approx(-1, rel=1e-5)
    with pytest.raises(GeometryError, match=r"has norm 1\.0e\+00, above 1\.0e-01.*measure it better"):
        stabilise(C, np.zeros((1, 1)), stable_abscissa(), max_gain=0.1)
    monkeypatch.setattr("scipy.linalg.solve_continuous_are", lambda *_: np.zeros((1, 1)))
    with pytest.raises(GeometryError, match=r"leaves eigenvalues at \[.*measure it better"):
        stabilise(C, np.ones((1, 1)), stable_abscissa())


@pytest.mark.parametrize("region", [stable_radius(), stable_abscissa()])
@pytest.mark.parametrize("error", [ValueError("Reordering of (A, B) failed"), np.linalg.LinAlgError("no solution")])
def test_a_riccati_equation_that_fails_is_a_geometric_answer(
    monkeypatch: pytest.MonkeyPatch, region: Stability, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("scipy.linalg.solve_continuous_are", fail)
    monkeypatch.setattr("scipy.linalg.solve_discrete_are", fail)
    with pytest.raises(GeometryError, match=r"can be computed for this pair .*measure it better"):
        stabilise(np.eye(1), np.eye(1), region)


def test_a_measurement_that_repeats_another_is_no_further_output() -> None:
    """Both see W, and their difference sees nothing but rounding: the mode 2 outside W cannot be moved."""
    A, B, C = np.diag([0.5, 2.0]), np.array([[1.0], [0.0]]), np.array([[0.1, 0.7], [0.3, 2.1]])
    W = unknown_input_structure(C, A, B, stable_radius()).W
    assert W.shape[1] == 1
    with pytest.raises(GeometryError, match="fixed and outside"):
        reduced_observer(C, A, W, stable_radius())


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    st.lists(st.integers(1, 3), min_size=1, max_size=2),
    st.integers(0, 2),
    st.integers(0, 4),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_filter_on_planted_systems(chains: list[int], free: int, seen: int, seed: int, placed: bool) -> None:
    """P (A + L C) = Abar P, P B = 0, the good zeros stay, everything else goes where it is sent."""
    s = morse(np.random.default_rng(seed), [0.4, -0.6], [1.3], chains, free, seen)
    region = stable_radius(0.95)
    structure = unknown_input_structure(s.C, s.A, s.B, region)
    poles = [0.1, -0.15, 0.2, -0.25][:4]
    made = reduced_observer(s.C, s.A, structure.Wg, region, poles if placed else None, L=structure.L)
    size = np.linalg.norm(s.A, 2) + np.linalg.norm(made.L, 2) * np.linalg.norm(s.C, 2)
    assert np.abs(made.P @ (s.A + made.L @ s.C) - made.Abar @ made.P).max() < 1e-9 * size
    assert np.abs(made.P @ s.B).max() < 1e-9
    assert distance(made.fixed, [0.4, -0.6]) < 1e-7
    assert np.abs(made.eigenvalues).max() < 0.95
    if placed:
        assert distance(made.eigenvalues, [0.4, -0.6, *poles[:seen]]) < 1e-3
    # the start matters only for where the friend sits, not for the spectrum
    again = reduced_observer(s.C, s.A, structure.Wg, region, poles if placed else None)
    assert distance(again.eigenvalues, made.eigenvalues) < 1e-3


def test_seed_003_gains() -> None:
    """Poles -2, -3 and the smallest friends, as derived by hand in the notes."""
    expected = {
        1: [[-5, 0, 0, 0, 0, 0], [0, -1, 0, 3, 3, 0]],
        2: [[0, -2, 0, 0, 0, -4]],
        3: [[0, 0, -3, 3, 0, 0], [-3, 1, 0, 0, 3, -1]],
        4: [[-3, 0, 0, 0, 0, 0]],
    }
    for i, gains in expected.items():
        s = unknown_input_structure(GEO_C[i], GEO_A, GEO_B[:, GEO_UNKNOWN[i]], stable_abscissa())
        made = reduced_observer(GEO_C[i], GEO_A, s.Wg, stable_abscissa(), poles=[-2, -3, -4], L=s.L)
        assert pytest.approx(np.array(gains, dtype=float), abs=1e-10) == made.L.T


def test_seed_003_node_1_where_scipy_returns_a_wrong_answer_without_a_word() -> None:
    """X/W*_g keeps the zero -2 whatever L is: only two of three poles can be asked for, and only two are."""
    s = unknown_input_structure(GEO_C[1], GEO_A, GEO_B[:, GEO_UNKNOWN[1]], stable_abscissa())
    made = reduced_observer(GEO_C[1], GEO_A, s.Wg, stable_abscissa(), poles=[-5, -6, -7], L=s.L)
    assert distance(made.eigenvalues, [-5, -6, -2]) < 1e-9
    assert np.linalg.norm(made.L, 2) < 20
    with pytest.raises(GeometryError, match="2 poles can be placed on X/W but only 1"):
        reduced_observer(GEO_C[1], GEO_A, s.Wg, stable_abscissa(), poles=[-5])
    with pytest.raises(GeometryError, match="outside Re lambda < -3"):
        reduced_observer(GEO_C[1], GEO_A, s.Wg, stable_abscissa(-3.0), poles=[-5, -6])


def test_seed_003_centralised_gain() -> None:
    """Poles -3, -4: the L of the paper's supplement, all six digits of it."""
    A, B, C = np.array([[2.0, -2, 0], [0, 0, 1], [0, -2, 1]]), np.array([[1.0], [1], [0]]), np.eye(3)[:2]
    s = unknown_input_structure(C, A, B, stable_abscissa())
    assert (s.W.shape[1], s.S.shape[1], s.zeros.size) == (1, 1, 0)
    made = reduced_observer(C, A, s.Wg, stable_abscissa(), poles=[-3, -4], L=s.L)
    assert pytest.approx(np.array([[-5.0, 5], [5, -5], [20, -18]]), abs=1e-10) == made.L


def test_seed_002_every_eigenvalue_is_a_fixed_zero() -> None:
    """Nothing can be placed in the paper's example; P'P and P'P L agree with the printed numbers to their rounding."""
    printed_P = {
        2: [[0.0984, 0.9939, -0.0491, 0.0025, 0, 0]],
        3: [[0, 0, 0.9987, -0.0505, 0, 0]],
        4: [[0, 0, 0, 1, 0, 0], [0, 0.0035, -0.9957, 0, 0.0093, -0.0923], [0, -0.0375, -0.0928, 0, -0.0998, 0.9900]],
    }
    printed_L = {
        2: [-0.2244, -0.9990, 0.0252, -0.0090, 0.4797, -2.0659],
        3: [0, 0, -1.9754, 0.0998, 0, 0],
        4: [-1.0799, 0.0809, 0, 0, 0.2710, -1.9582],
    }
    region = stable_radius(0.99)
    for i in printed_P:
        s = unknown_input_structure(SIX_C[i], SIX_A, SIX_B[:, SIX_UNKNOWN[i]], region)
        made = reduced_observer(SIX_C[i], SIX_A, s.Wg, region, L=s.L)
        assert distance(made.eigenvalues, made.fixed) < 1e-12
        P, L = np.array(printed_P[i]), np.array(printed_L[i])
        assert np.abs(made.P.T @ made.P - P.T @ P).max() < 1.2e-4
        assert np.abs(made.P.T @ made.P @ made.L[:, 0] - P.T @ P @ L).max() < 3e-4
        assert np.abs(made.P @ (SIX_A + made.L @ SIX_C[i]) - made.Abar @ made.P).max() < 1e-13
