"""What is printed of the certificate's ``node_loss``: the table of ``--check``, a sentence on the recording's page."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import pytest

import duio_mesh
from duio_mesh import cli, console
from duio_mesh.report.description import describe
from duio_mesh.report.losses import node_loss_in_words
from tests.conftest import TOPOLOGIES


def case(radius: float | None, failing: tuple[int, ...] = (), **left: float) -> dict[str, Any]:
    return {"radius": radius, "failing": [list(failing)] if failing else [], **left}


def test_a_sentence_for_each_kind() -> None:
    cases = {1: case(0.5, left=0.02), 2: case(1.25, (1, 3), left=1.0), 3: case(0.99, left=0.4), 4: case(0.7, left=0.1)}
    assert node_loss_in_words(cases, "degrade") == (
        "If a node is lost (`degrade`): without node 1 or 4 the others still reconstruct; without node 3 the others "
        "still reconstruct, but too slowly to be of use; without node 2 the others no longer reconstruct. "
        "Largest spectral radius: 1.25, without node 2."
    )
    many = {i: case(0.5 + 0.001 * i) for i in range(64)} | {7: case(None, (1, 2))}
    assert node_loss_in_words(many, "restart") == (
        "If a node is lost (`restart`): without any one of 63 nodes the others still reconstruct; "
        "without node 7 the others no longer reconstruct."
    )
    assert node_loss_in_words({}, "restart") == ""  # a node alone has no others


def rows(out: str) -> dict[str, tuple[float, str]]:
    """What is lost -> (radius, the rest), as a table prints it."""
    found = re.findall(r"│ (node \d[^│]*?) +│ ([\d.]+) +│ ([^│]*?) +│", out)
    return {lost: (float(radius), words) for lost, radius, words in found}


def test_check_prints_what_each_loss_leaves(capsys: pytest.CaptureFixture[str]) -> None:
    """The same table as --contingency has of nodes alone, but only where the run goes on without a lost node."""
    file = str(TOPOLOGIES / "admm_ring.yaml")
    assert cli.main([file, "--check", "--set", "run.on_node_loss=restart"]) == 0
    out = capsys.readouterr().out
    assert "when a node is lost (restart)" in " ".join(out.split())
    assert "node_loss" not in out
    found = rows(out)
    assert {lost: words for lost, (_, words) in found.items()} == {
        "node 1": "too slowly: a step leaves 95% of the error",
        "node 2": "does not: nodes [1, 3, 4]",
        "node 3": "reconstructs",
        "node 4": "does not: nodes [1, 2, 3]",
    }
    assert re.search(r"survives +2 of 4, 1 of them too slowly", out)
    assert cli.main([file, "--check", "--contingency", "1"]) == 0
    out = capsys.readouterr().out
    assert "when a node is lost" not in " ".join(out.split())
    assert rows(out) == found
    assert re.search(r"survives +6 of 8, 1 of them too slowly", out)


def test_of_many_nodes_the_worst_are_shown(capsys: pytest.CaptureFixture[str]) -> None:

    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml"))
    cases = {i: {"lost": f"node {i}"} | case(0.9 - 0.001 * i) for i in range(1, 65)}
    cases[50] = {"lost": "node 50"} | case(1.1, (1, 2))
    console.certificate(replace(design, certificate={**design.certificate, "node_loss": cases}))
    out = capsys.readouterr().out
    found = rows(out)
    assert list(found)[:3] == ["node 50", "node 1", "node 2"]
    assert list(found)[-2:] == ["node 32 (median of 64)", "node 64 (best)"]
    assert len(found) == 10
    assert re.search(r"survives +63 of 64\n", out)


def test_the_page_of_a_recording_says_it_in_a_sentence() -> None:
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml", **{"run.on_node_loss": "degrade"})
    page = describe(scenario, duio_mesh.synthesise(scenario).certificate)
    assert "without node 1, 2, 3 or 4 the others still reconstruct. Largest spectral radius: 0.930815" in page
    assert "node_loss" not in page
