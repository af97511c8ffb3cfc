"""Lists of numbers -> arrays of the right shape, or a message that says which row is wrong and what sets its length."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.scenario.problems import Path, Problems, counted


class Size(NamedTuple):
    """How many there should be and why: Size(9, 'one per state')."""

    number: int
    why: str


def matrix(
    rows: list[list[float]] | None,
    path: Path,
    problems: Problems,
    *,
    height: Size | None = None,
    width: Size | None = None,
) -> Array | None:
    """(height, width); a size that is None is not known and only has to be the same in all rows."""
    if rows is None:
        return None
    columns = width.number if width else len(rows[0]) if rows else 0
    wrong = [k for k, row in enumerate(rows) if len(row) != columns]
    why = width.why if width else "as the first row"
    if width and len(wrong) > 1 and len({len(row) for row in rows}) == 1:
        problems.at(path, f"should have {counted(columns, 'column')} ({why}), not {len(rows[0])}")
    else:
        for k in wrong:
            problems.at((*path, k), f"should have {counted(columns, 'entry')} ({why}), not {len(rows[k])}")
    if height and len(rows) != height.number:
        problems.at(path, f"should have {counted(height.number, 'row')} ({height.why}), not {len(rows)}")
        return None
    return None if wrong else np.array(rows, dtype=np.float64).reshape(len(rows), columns)


def vector(values: list[float] | None, path: Path, problems: Problems, size: Size | None) -> Array | None:
    """(size,)"""
    if values is None or size is None:
        return None
    return np.array(values, dtype=np.float64) if has_length(values, path, problems, size) else None


def has_length(values: Sequence[object], path: Path, problems: Problems, size: Size) -> bool:
    """Does the list have this many entries? Reports it when not."""
    if len(values) != size.number:
        problems.at(path, f"should have {counted(size.number, 'entry')} ({size.why}), not {len(values)}")
    return len(values) == size.number


def weight(
    written: float | list[float] | list[list[float]] | None, path: Path, problems: Problems, size: Size | None
) -> Array | None:
    """(size, size) from a number (times the identity), a diagonal or a whole matrix; symmetric."""
    if written is None or size is None:
        return None
    if isinstance(written, float | int):
        return float(written) * np.eye(size.number)
    if written and isinstance(written[0], list):
        full = matrix(written, path, problems, height=size, width=size)
        if full is not None and not np.array_equal(full, full.T):
            problems.at(path, "should be symmetric")
            return None
        return full
    diagonal = vector(written, path, problems, size)  # type: ignore[arg-type]  # a list of numbers
    return None if diagonal is None else np.diag(diagonal)
