"""Rerun swallows wrong calls with a warning by default; here they are errors."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def strict_rerun() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)
