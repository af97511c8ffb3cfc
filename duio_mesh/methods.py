"""The registry of observers: one line per method, and the only line to add for a new one.

A method called ``name`` is three things that are found by that name:

- ``duio_mesh/synthesis/name.py`` with ``Options`` (the keys under ``observer:``) and ``design(scenario)``,
- ``duio_mesh/observers/name.py`` with ``Observer`` (the step machine that a node runs),
- ``docs/observers/name.md``.
"""

from __future__ import annotations

METHODS: tuple[str, ...] = (
    "admm",
    "augmented",
    "geometric",
    "lmi",
    "reduced_order",
)
