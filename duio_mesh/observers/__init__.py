"""Online: what one node computes. One file per method; numpy only; see ``base`` for the contract."""

from __future__ import annotations

import importlib

from duio_mesh.methods import METHODS
from duio_mesh.observers.absence import guarded
from duio_mesh.observers.base import Estimate, Observer
from duio_mesh.spec import NodeSpec

__all__ = ["Estimate", "Observer", "make_observer"]


def make_observer(spec: NodeSpec) -> Observer:
    """The step machine that ``spec.method`` names. Raises ValueError for a method that is not registered."""
    if spec.method not in METHODS:
        raise ValueError(f"unknown observer method {spec.method!r}; known: {', '.join(METHODS)}")
    observer: Observer = importlib.import_module(f"duio_mesh.observers.{spec.method}").Observer(spec)
    return guarded(observer, spec)
