"""trace.npz: the arrays of a run under the names that the run folder's contract gives them (docs/design.md)."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from duio_mesh.trace import Trace

_VHAT, _SAMPLE = "vhat_", "sample_"


def write_trace(path: Path, trace: Trace) -> None:
    """Write ``trace`` to ``path`` whole or not at all: it is written under a temporary name and then renamed.

    Raises OSError when that is impossible; no file with the temporary name is left then.
    """
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    try:
        with temporary.open("wb") as f:
            arrays: dict[str, Any] = dict(trace.arrays())
            np.savez(f, allow_pickle=False, **arrays)
            f.flush()
            os.fsync(f.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_trace(path: Path) -> Trace:
    """Read what ``write_trace`` wrote; nothing in the file can be executed (no pickle).

    Raises ValueError when the file is not a trace, OSError when it cannot be read.
    """
    try:
        with path.open("rb") as f, np.load(f, allow_pickle=False) as arrays:
            named = {name: arrays[name] for name in arrays.files}
        trace = Trace(
            t=named.pop("t"),
            x=named.pop("x"),
            node_ids=named.pop("node_ids"),
            xhat=named.pop("xhat"),
            what=named.pop("what", None),
            flagged=named.pop("flagged", None),
            vhat=_by_node(named, _VHAT),
            samples=_by_node(named, _SAMPLE),
        )
    except (KeyError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as e:
        raise ValueError(f"{path} is not a trace: {e}") from None
    _check(path, trace, sorted(named))
    return trace


def _by_node(named: dict[str, Any], prefix: str) -> dict[int, Any]:
    """Take the arrays out that have this prefix, by the node's id behind it."""
    return {int(name.removeprefix(prefix)): named.pop(name) for name in list(named) if name.startswith(prefix)}


def _check(path: Path, trace: Trace, unknown: list[str]) -> None:
    """Raise ValueError when the arrays do not fit together."""
    if unknown:
        raise ValueError(f"{path} is not a trace: unknown arrays {', '.join(unknown)}")
    K, n = trace.x.shape if trace.x.ndim == 2 else (-1, -1)
    N = trace.node_ids.shape[0] if trace.node_ids.ndim == 1 else -1
    wrong = [
        f"{name} {array.shape}"
        for name, array, fits in (
            ("t", trace.t, trace.t.shape == (K,)),
            ("xhat", trace.xhat, trace.xhat.shape == (N, K, n)),
            ("what", trace.what, trace.what is None or trace.what.shape[:2] == (N, K)),
            ("flagged", trace.flagged, trace.flagged is None or trace.flagged.shape == (N, K)),
            *((f"{_VHAT}{i}", v, v.shape[:1] == (K,) and i in trace.node_ids) for i, v in trace.vhat.items()),
            *((f"{_SAMPLE}{i}", s, s.shape[:1] == (K,) and i in trace.node_ids) for i, s in trace.samples.items()),
        )
        if not fits and array is not None
    ]
    if wrong:
        given = f"x {trace.x.shape} and node_ids {trace.node_ids.shape}"
        raise ValueError(f"{path} is not a trace: {given} do not fit {', '.join(wrong)}")
