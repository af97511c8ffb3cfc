"""The fault model itself: the same answers in any order, no matter who asks, and the rates that were asked for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from duio_mesh.faults import Edge, Fate, Faults, Reception, Rule, Stamp
from duio_mesh.spec import NodeSpec, read_spec, write_spec

EVERYTHING = Rule(
    3, loss=0.1, burst=(0.05, 0.3, 0.01, 0.8), delay_steps=(0, 2), delay_rounds=(0, 3), duplicate=0.2, reorder=0.1,
    corrupt=0.05,
)  # fmt: skip
MANY = 20_000


def edge(*rules: Rule, seed: int = 1, source: int = 1, target: int = 2) -> Edge:
    return Edge(seed, source, target, rules)


def within_binomial(hits: int, trials: int, p: float) -> bool:
    """Five standard deviations: missed once in two million honest models."""
    return abs(hits - trials * p) <= 5 * math.sqrt(trials * p * (1 - p))


def test_the_order_of_asking_does_not_matter() -> None:
    stamps = [(k, r) for k in range(300) for r in range(3)]
    in_order, shuffled = edge(EVERYTHING), edge(EVERYTHING)
    fates = {stamp: in_order.fate(*stamp) for stamp in stamps}
    for at in np.random.default_rng(0).permutation(len(stamps)):
        assert shuffled.fate(*stamps[at]) == fates[stamps[at]]
    assert len({*fates.values()}) > 100


def test_the_fates_of_a_seed_are_written_in_stone() -> None:
    """A change here changes every run that was ever recorded with faults."""
    lost = [k for k in range(100) if edge(Rule(0, loss=0.1), seed=7).fate(k, 0).lost]
    assert lost == [4, 5, 12, 15, 39, 43, 55, 58, 59, 75, 79, 84, 92, 94, 95]


@pytest.mark.parametrize("other", [{"seed": 2}, {"source": 3}, {"target": 3}, {"source": 2, "target": 1}])
def test_edges_directions_and_seeds_are_independent(other: dict[str, int]) -> None:
    """Both lose a frame as often as two independent coins would."""
    a, b = edge(Rule(0, loss=0.3)), edge(Rule(0, loss=0.3), **other)
    both = sum(a.fate(k, 0).lost and b.fate(k, 0).lost for k in range(MANY))
    assert within_binomial(both, MANY, 0.09)


def test_rounds_steps_and_rules_are_independent() -> None:
    a, b = edge(Rule(0, loss=0.3)), edge(Rule(1, loss=0.3))
    assert within_binomial(sum(a.fate(k, 0).lost and b.fate(k, 0).lost for k in range(MANY)), MANY, 0.09)
    assert within_binomial(sum(a.fate(k, 0).lost and a.fate(k, 1).lost for k in range(MANY)), MANY, 0.09)
    assert within_binomial(sum(a.fate(k, 0).lost and a.fate(k + 1, 0).lost for k in range(MANY)), MANY, 0.09)


@pytest.mark.parametrize("p", [0.0, 0.01, 0.2, 1.0])
def test_rates(p: float) -> None:
    faulty = edge(Rule(0, loss=p, duplicate=p, reorder=p, corrupt=p))
    fates = [faulty.fate(k, 0) for k in range(MANY)]
    for count in (
        sum(f.lost for f in fates),
        sum(f.corrupt for f in fates),
        sum(f.duplicate for f in fates),
        sum(f.rounds for f in fates),
    ):
        assert within_binomial(count, MANY, p)


def test_random_delays_are_uniform() -> None:
    faulty = edge(Rule(0, delay_steps=(1, 4)))
    counts = np.bincount([faulty.fate(k, 0).steps for k in range(MANY)], minlength=6)
    assert counts[0] == counts[5] == 0
    assert all(within_binomial(count, MANY, 0.25) for count in counts[1:5])


@pytest.mark.parametrize(("worsen", "mend"), [(0.02, 0.2), (0.3, 0.5), (0.8, 0.7), (1.0, 1.0), (0.001, 1.0)])
def test_gilbert_elliott_bursts(worsen: float, mend: float) -> None:
    """Both transition frequencies, which fix the mean length of good and bad spells and the loss."""
    faulty = edge(Rule(0, burst=(worsen, mend, 0.0, 1.0)))
    bad = np.array([faulty.fate(k, 0).lost for k in range(MANY)])
    after_good, after_bad = bad[1:][~bad[:-1]], bad[1:][bad[:-1]]
    assert within_binomial(int(after_good.sum()), len(after_good), worsen)
    assert within_binomial(int((~after_bad).sum()), len(after_bad), mend)


def test_gilbert_elliott_starts_stationary() -> None:
    first = [edge(Rule(0, burst=(0.1, 0.3, 0.0, 1.0)), seed=s).fate(0, 0).lost for s in range(4000)]
    assert within_binomial(sum(first), 4000, 0.25)


def test_gilbert_elliott_losses_within_a_spell() -> None:
    """A spell lasts whole steps; within it each round is lost with the spell's own probability."""
    faulty = edge(Rule(0, burst=(0.5, 0.5, 0.0, 0.6)))
    lost = np.array([[faulty.fate(k, r).lost for r in range(10)] for k in range(3000)])
    spells = lost[lost.any(axis=1)]  # 0.4^10: hardly ever a bad step without a loss
    assert within_binomial(len(spells), 3000, 0.5)
    assert within_binomial(int(spells.sum()), spells.size, 0.6)


def test_a_rule_holds_during_its_steps() -> None:
    faulty = edge(Rule(0, during=(10, 20), loss=1.0))
    assert [k for k in range(40) if faulty.fate(k, 3).lost] == list(range(10, 20))


def test_rules_add_up() -> None:
    fate = edge(Rule(0, delay_steps=(1, 1)), Rule(1, delay_steps=(2, 2), delay_rounds=(1, 1)), Rule(2, duplicate=1.0))
    assert fate.fate(5, 0) == Fate(steps=3, rounds=1, duplicate=True)


def received(rules: dict[int, tuple[Rule, ...]], rounds: int, steps: int) -> dict[tuple[int, int], tuple[object, ...]]:
    """By (k, r): who is on time, and what arrives late."""
    reception = Reception(Faults(0, {(j, 9): r for j, r in rules.items()}).into(9), (1, 2))
    arrivals = {(k, r): reception.next(k, r) for k in range(steps) for r in range(rounds)}
    return {stamp: (a.on_time, a.late) for stamp, a in arrivals.items()}


def test_steps_late() -> None:
    found = received({1: (Rule(0, delay_steps=(2, 2)),)}, rounds=2, steps=4)
    assert found[1, 1] == ((2,), ())
    assert found[2, 0] == ((2,), (Stamp(1, 0, 0),))
    assert found[3, 1] == ((2,), (Stamp(1, 1, 1),))


def test_rounds_late_go_on_in_the_next_step() -> None:
    found = received({2: (Rule(0, during=(0, 1), delay_rounds=(3, 3)),)}, rounds=2, steps=3)
    assert found[0, 0] == ((1,), ())
    assert found[1, 0] == ((1, 2), ())
    assert found[1, 1] == ((1, 2), (Stamp(2, 0, 0),))
    assert found[2, 0] == ((1, 2), (Stamp(2, 0, 1),))


def test_every_frame_is_lost_or_arrives_once() -> None:
    reception = Reception(Faults(5, {(1, 9): (EVERYTHING,)}).into(9), (1,))
    seen: list[tuple[int, int]] = []
    for k in range(200):
        for r in range(2):
            arrivals = reception.next(k, r)
            seen += [(k, r)] * (1 in arrivals.on_time) + [(s.k, s.r) for s in arrivals.late]
            assert all((s.k, s.r) < (k, r) for s in arrivals.late)
    assert len(seen) == len(set(seen))
    twin = Edge(5, 1, 9, [EVERYTHING])
    early = {(k, r) for k in range(190) for r in range(2)}  # all that these send has had the time to arrive
    assert early & set(seen) == {stamp for stamp in early if twin.fate(*stamp).arrives}


def test_a_node_knows_its_own_in_edges_only(tmp_path: Path) -> None:
    rules = {(1, 2): (EVERYTHING,), (2, 1): (Rule(0, loss=0.5),), (3, 2): (Rule(1, loss=1.0),)}
    faults = Faults(11, rules)
    assert set(faults.into(2).rules) == {1, 3}
    assert not faults.into(3).rules
    spec = NodeSpec(
        id=2, method="lmi", n=1, p=1, m=0, matrices={}, options={}, hears={1: 1.0, 3: 1.0}, tells=(1,), steps=1,
        deadline=1.0, window=4, credit=1, block=1, batch=1, faults=faults.into(2), without="skip",
    )  # fmt: skip
    write_spec(spec, tmp_path / "node.spec")
    read = read_spec(tmp_path / "node.spec", NodeSpec)
    assert read == spec
    everywhere, own = Edge(11, 1, 2, rules[1, 2]), Edge(read.faults.seed, 1, 2, read.faults.rules[1])
    assert all(everywhere.fate(k, 0) == own.fate(k, 0) for k in range(200))
