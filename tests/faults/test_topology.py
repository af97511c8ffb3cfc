"""What ``faults:`` in a topology file means."""

from __future__ import annotations

from pathlib import Path

from duio_mesh.faults import ALWAYS, Faults, NodeFault, Rule
from tests.scenario.broken import VALID
from tests.scenario.stand_in import load

WRITTEN = """
faults:
  links:
    - {loss: 0.05}
    - {edges: [[2, 1]], gilbert_elliott: {worsen: 0.01, mend: 0.2}, during: [3, 9]}
    - {arcs: [[1, 2]], delay: {steps: [0, 2]}, duplicate: 0.1, reorder: 0.2, corrupt: 0.3}
    - {arcs: [[1, 2]], delay: {rounds: 4}}
  cuts:
    - {edges: [[1, 2]], during: [4, 6]}
  nodes:
    - {node: 2, pause: 6, seconds: 1.5}
    - {node: 1, restart: 7}
    - {node: 2, restart: 8, away: 3}
"""


def faults(tmp_path: Path, text: str) -> Faults:
    (tmp_path / "t.yaml").write_text(VALID.replace("seed: 0", "seed: 42\n  on_node_loss: restart") + text)
    return load(tmp_path / "t.yaml").faults


def test_every_part_arrives(tmp_path: Path) -> None:
    found = faults(tmp_path, WRITTEN)
    everywhere, cut = Rule(0, loss=0.05), Rule(4, (4, 6), loss=1.0)
    burst = Rule(1, (3, 9), burst=(0.01, 0.2, 0.0, 1.0))
    one_way = Rule(2, delay_steps=(0, 2), duplicate=0.1, reorder=0.2, corrupt=0.3)
    assert found.seed == 42
    assert found.links == {
        (1, 2): (everywhere, burst, one_way, Rule(3, ALWAYS, delay_rounds=(4, 4)), cut),
        (2, 1): (everywhere, burst, cut),
    }
    assert found.nodes == (
        NodeFault(2, "pause", 6, 1.5),
        NodeFault(1, "restart", 7, away=10),
        NodeFault(2, "restart", 8, away=3),
    )
    assert found.absences(2) == ((8, 11),)
    assert found.returns() == {11: (2,), 17: (1,)}
    assert found.into(1, (2,)).absent == {2: ((8, 11),)}


def test_a_sender_learns_only_what_it_has_to_do_itself(tmp_path: Path) -> None:
    found = faults(tmp_path, WRITTEN)
    spoilt = found.spoilt_by(1)[2]
    assert {(r.number, r.corrupt, r.duplicate) for r in spoilt if r.corrupt} == {(2, 0.3, 0.1)}
    assert all(r.loss == 0 and not r.burst and r.delay_steps == (0, 0) for r in spoilt)
    assert found.spoilt_by(2) == {}


def test_a_seed_of_their_own(tmp_path: Path) -> None:
    assert faults(tmp_path, "faults: {seed: 7}\n").seed == 7


def test_nothing_means_no_faults(tmp_path: Path) -> None:
    for text in ("", "faults:\n", "faults: {}\n"):
        found = faults(tmp_path, text)
        assert (dict(found.links), found.nodes) == ({}, ())
