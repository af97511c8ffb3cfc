"""Spans, pairing and thinning against the plain sets and arrays that they stand for."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from duio_mesh.report import pairing
from duio_mesh.report.pairing import Decimator, Pairing, Spans, log_norms, runs

exact = settings(deadline=None, derandomize=True, max_examples=100)
span = st.tuples(st.integers(0, 40), st.integers(0, 12)).map(lambda s: (s[0], s[0] + s[1]))


@exact
@given(st.lists(span, max_size=12), span)
def test_spans_are_a_set_of_steps(added: list[tuple[int, int]], asked: tuple[int, int]) -> None:
    spans, plain = Spans(), set[int]()
    for first, last in added:
        spans.add(first, last)
        plain |= set(range(first, last))
    kept = list(spans)
    assert set(itertools.chain(*(range(a, b) for a, b in kept))) == plain
    assert all(a < b for a, b in kept)
    assert all(b < c for (_, b), (c, _) in itertools.pairwise(kept)), "spans touch: they should have melted"
    gaps = spans.gaps(*asked)
    assert set(itertools.chain(*(range(a, b) for a, b in gaps))) == set(range(*asked)) - plain
    assert gaps == runs(np.array(sorted(set(range(*asked)) - plain), dtype=np.int64))


batches = st.lists(st.tuples(st.sampled_from([0, 1, 2]), st.integers(0, 29), st.integers(1, 12)), max_size=25)


@exact
@given(batches, st.sampled_from([1, 3, 8, 30]))
def test_errors_are_exact_in_any_order_and_unknown_only_when_a_row_had_no_chance(
    order: list[tuple[int, int, int]], window: int
) -> None:
    """Source 0 is the truth. Whatever is said is right, and with a window as long as the run nothing is lost."""
    K, n = 30, 2
    rng = np.random.default_rng(1)
    x, xhat = rng.standard_normal((K, n)), {i: rng.standard_normal((K, n)) for i in (1, 2)}
    pairs = _with_window(n, K, window)
    said: dict[int, dict[int, float]] = {1: {}, 2: {}}
    given_: dict[int, set[int]] = {0: set(), 1: set(), 2: set()}
    for source, k, length in order:
        last = min(K, k + length)
        given_[source] |= set(range(k, last))
        found = pairs.truth(k, x[k:last]) if source == 0 else [pairs.estimates(source, k, xhat[source][k:last])]
        for errors in found:
            said[errors.node] |= dict(zip(errors.steps.tolist(), errors.log10.tolist(), strict=True))
    for i in (1, 2):
        for k, value in said[i].items():
            assert value == pytest.approx(np.log10(np.linalg.norm(xhat[i][k] - x[k])), abs=1e-12)
        assert set(said[i]) == set(itertools.chain(*(range(a, b) for a, b in pairs.known[i])))
        if window >= K:
            assert set(said[i]) == given_[0] & given_[i]
        else:
            assert set(said[i]) <= given_[0] & given_[i]


def _with_window(n: int, steps: int, window: int) -> Pairing:
    pairs = Pairing(n, (1, 2), steps)
    pairs.window = window
    pairs._truth = pairing._Ring(window, n)
    pairs._early = {i: pairing._Ring(window, n) for i in (1, 2)}
    return pairs


def test_memory_does_not_grow_with_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    assert Pairing(18, range(64), 10**9).window * 8 * 18 * 65 <= pairing.MEMORY
    assert Pairing(9, range(4), 101).window == 101, "a short run keeps everything"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        ([3.0, 4.0], np.log10(5)),
        ([0.0, 0.0], -16.0),
        ([1e-200, 0.0], -16.0),
        ([3e200, 4e200], 200 + np.log10(5)),
        ([np.inf, 1.0], 308.0),
        ([-np.inf, np.inf], 308.0),
    ],
)
def test_log_norms_of_extreme_errors(error: list[float], expected: float) -> None:
    assert log_norms(np.array([error]))[0] == pytest.approx(expected, abs=1e-12)


def test_log_norms_of_nothing_and_of_nan() -> None:
    assert log_norms(np.zeros((0, 3))).shape == (0,)
    assert np.isnan(log_norms(np.array([[np.nan, 1.0]]))[0])


@exact
@given(st.integers(1, 9), st.lists(st.integers(1, 7), max_size=20), st.integers(0, 2**32 - 1))
def test_thinning_keeps_every_spike(stride: int, lengths: list[int], seed: int) -> None:
    """Per stretch of ``stride`` steps: the least and the greatest value, unchanged and at their own steps."""
    K = sum(lengths)
    values = np.random.default_rng(seed).standard_normal(K)
    thin, steps, kept = Decimator(stride), list[int](), list[float]()
    k = 0
    for length in lengths:
        s, v = thin.push(np.arange(k, k + length), values[k : k + length])
        steps, kept, k = steps + s.tolist(), kept + v.tolist(), k + length
    s, v = thin.drain()
    steps, kept = steps + s.tolist(), kept + v.tolist()
    assert steps == sorted(set(steps)), "in order, nothing twice"
    assert kept == values[steps].tolist()
    for first in range(0, K, stride):
        own = values[first : first + stride]
        inside = [v for s, v in zip(steps, kept, strict=True) if first <= s < first + stride]
        assert min(inside) == own.min()
        assert max(inside) == own.max()
        assert len(inside) <= max(2, 0 if stride > 2 else stride)


def test_thinning_of_a_late_batch_loses_neither_it_nor_what_was_held_back() -> None:
    thin = Decimator(10)
    first = thin.push(np.arange(20, 25), np.array([1.0, 9.0, 2.0, -5.0, 3.0]))
    late = thin.push(np.arange(0, 10), np.arange(10.0))
    rest = thin.drain()
    steps = np.concatenate([first[0], late[0], rest[0]])
    values = np.concatenate([first[1], late[1], rest[1]])
    assert dict(zip(steps.tolist(), values.tolist(), strict=True)) == {0: 0.0, 9: 9.0, 21: 9.0, 23: -5.0}
