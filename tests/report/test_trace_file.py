"""trace.npz: what is written is read back bit for bit, whole or not at all, and nothing in it is executed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from duio_mesh.report import trace_file
from duio_mesh.report.trace_file import read_trace, write_trace
from duio_mesh.trace import Trace


def make_trace(**changes: Any) -> Trace:
    rng = np.random.default_rng(0)
    xhat = rng.standard_normal((2, 5, 3))
    xhat[1, 3:] = np.nan
    fields: dict[str, Any] = {
        "t": np.arange(5) * 0.1,
        "x": rng.standard_normal((5, 3)),
        "node_ids": np.array([2, 7]),
        "xhat": xhat,
        "what": rng.standard_normal((2, 5, 1)),
        "vhat": {7: rng.standard_normal((5, 2))},
    }
    return Trace(**(fields | changes))


@pytest.mark.parametrize("changes", [{}, {"what": None, "vhat": {}}])
def test_there_and_back(tmp_path: Path, changes: dict[str, Any]) -> None:
    trace = make_trace(**changes)
    write_trace(tmp_path / "trace.npz", trace)
    back = read_trace(tmp_path / "trace.npz")
    assert back.arrays().keys() == trace.arrays().keys()
    for name, array in trace.arrays().items():
        assert back.arrays()[name].dtype == array.dtype
        assert back.arrays()[name].tobytes() == array.tobytes()
    assert os.listdir(tmp_path) == ["trace.npz"]


def test_the_names_are_those_of_the_contract(tmp_path: Path) -> None:
    write_trace(tmp_path / "trace.npz", make_trace())
    with np.load(tmp_path / "trace.npz", allow_pickle=False) as file:
        assert {name: file[name].shape for name in file.files} == {
            "t": (5,),
            "x": (5, 3),
            "node_ids": (2,),
            "xhat": (2, 5, 3),
            "what": (2, 5, 1),
            "vhat_7": (5, 2),
        }


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "trace.npz"
    write_trace(path, make_trace())
    before = path.read_bytes()

    def fail(*_: object, **__: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(trace_file.os, "fsync", fail)
    with pytest.raises(OSError, match="no space"):
        write_trace(path, make_trace(what=None))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["trace.npz"]


def test_objects_are_neither_written_nor_read(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="allow_pickle"):
        write_trace(tmp_path / "trace.npz", make_trace(x=np.array([print], dtype=object)))
    assert os.listdir(tmp_path) == []
    np.savez(tmp_path / "evil.npz", t=np.array([print], dtype=object))
    with pytest.raises(ValueError, match="is not a trace"):
        read_trace(tmp_path / "evil.npz")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 torn", b"no zip at all"])
def test_what_is_not_a_trace_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "trace.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"trace\.npz is not a trace"):
        read_trace(path)


def test_a_torn_file_is_refused(tmp_path: Path) -> None:
    write_trace(tmp_path / "trace.npz", make_trace())
    whole = (tmp_path / "trace.npz").read_bytes()
    for kept in range(0, len(whole), 97):
        (tmp_path / "torn.npz").write_bytes(whole[:kept])
        with pytest.raises(ValueError, match="is not a trace"):
            read_trace(tmp_path / "torn.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"xhat": np.zeros((2, 4, 3))}, r"xhat \(2, 4, 3\)"),
        ({"t": np.zeros(4)}, r"t \(4,\)"),
        ({"what": np.zeros((3, 5, 1))}, r"what \(3, 5, 1\)"),
        ({"vhat": {7: np.zeros((4, 1))}}, r"vhat_7 \(4, 1\)"),
        ({"vhat": {3: np.zeros((5, 1))}}, r"vhat_3 \(5, 1\)"),
        ({"x": np.zeros(5)}, r"x \(5,\)"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "trace.npz", allow_pickle=False, **make_trace(**changes).arrays())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=message):
        read_trace(tmp_path / "trace.npz")


def test_missing_and_unknown_arrays_are_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.zeros(1))
    with pytest.raises(ValueError, match="'x'"):
        read_trace(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", allow_pickle=False, more=np.zeros(1), **make_trace().arrays())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unknown arrays more"):
        read_trace(tmp_path / "b.npz")


def test_no_file_is_not_a_wrong_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        read_trace(tmp_path / "trace.npz")
