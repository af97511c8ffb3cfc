"""Many nodes: what a person sees of them, and limits of the machine that are said before anything starts."""

from __future__ import annotations

import resource

import pytest

from duio_mesh.console import FEW, MANY, chosen
from duio_mesh.errors import RunError
from duio_mesh.limits import check_files


def nodes(count: int) -> dict[str, dict[str, float | None]]:
    """Errors that grow with the id, but for node 5, which has none."""
    return {str(i): {"rms": None if i == 5 else float(i)} for i in range(1, count + 1)}


def test_the_table_of_few_nodes_has_all_in_their_order() -> None:
    assert [name for name, _ in chosen(nodes(MANY), "rms")] == [str(i) for i in range(1, MANY + 1)]


def test_the_table_of_many_nodes_has_the_worst_the_median_and_the_best() -> None:
    names = [name for name, _ in chosen(nodes(128), "rms")]
    assert names[:FEW] == ["5", "128", "127", "126", "125", "124", "123", "122"]
    assert names[FEW:] == ["65 (median of 128)", "1 (best)"]


def test_too_few_open_files_are_said_with_the_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (100, 150))
    check_files(50)
    with pytest.raises(RunError, match=r"100 are allowed: ulimit -n 112$"):
        check_files(64)
    with pytest.raises(RunError, match=r"needs a higher hard limit \(now 150"):
        check_files(128)
