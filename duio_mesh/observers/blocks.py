"""Arithmetic whose bits do not depend on how many steps are computed at once.

A block holds W estimation problems side by side as an (n, W) array, flattened to one vector of n W numbers on the wire.
BLAS multiplies a matrix with a vector in another order than with a block (W = 1 differs from W = 2), so column w of the
result would depend on W. Here every product is a sum of elementwise products of columns, added in index order.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from duio_mesh.arrays import Array, contiguous


def sum_rows(terms: Array, out: Array) -> None:
    """out = terms[0] + terms[1] + ..., in this order for every shape."""
    if out.size == 1:  # numpy would add a single column pairwise
        total = terms.reshape(-1)
        out.reshape(-1)[0] = sum(total[1:].tolist(), total[0])
    else:
        np.add.reduce(terms, axis=0, out=out)


class ColumnProduct:
    """out = M x + added[0] + added[1] + ... for a bound block x (columns of M, W).

    M's columns times x's rows, summed in order, then what is added.
    """

    def __init__(self, M: Array, x: Array, out: Array, more: int = 0) -> None:
        """``x`` and ``out`` are flat buffers of M.shape[1] * W and M.shape[0] * W numbers, used in place.

        ``out`` may be ``x``. ``more``: how many buffers of the size of ``out`` are added, ``added`` (more, out.size).
        """
        rows, columns = M.shape
        width = out.size // rows
        single = width == 1
        self._columns = contiguous(M.T) if single else contiguous(M.T)[:, :, None]
        self._x = x.reshape((columns, 1) if single else (columns, 1, width))
        self._terms = np.zeros((columns + more, rows) if single else (columns + more, rows, width))
        self._products = self._terms[:columns]
        self.added: Array = self._terms[columns:].reshape(more, out.size)
        self._out = out if single else out.reshape(rows, width)
        self._empty = columns + more == 0

    def __call__(self) -> None:
        """Compute it from what x holds now."""
        if self._empty:
            self._out.fill(0.0)
            return
        np.multiply(self._columns, self._x, self._products)
        sum_rows(self._terms, self._out)


class Neighbourhood:
    """This node's value and the latest one of every neighbour: one row each, own first, then ascending ids."""

    def __init__(self, ids: Mapping[int, float] | tuple[int, ...], size: int) -> None:
        self._rows = np.zeros((1 + len(ids), size))
        self._terms = np.zeros_like(self._rows)
        self.own: Array = self._rows[0]
        self._of = tuple(zip(sorted(ids), self._rows[1:], strict=True))

    def forget(self) -> None:
        """Everybody's value is zero again."""
        self._rows.fill(0.0)

    def receive(self, received: Mapping[int, Array]) -> None:
        """Take the neighbours' values; who is missing keeps the last one."""
        for j, row in self._of:
            vector = received.get(j)
            if vector is not None:
                row[:] = vector

    def assume_own(self, received: Mapping[int, Array]) -> None:
        """Take the neighbours' values; who is missing is taken to agree with this node."""
        for j, row in self._of:
            row[:] = received.get(j, self.own)

    def weights(self, own: float, others: Mapping[int, float]) -> Array:
        """Weights for ``combine``: a number for the own value and one per neighbour."""
        column = np.array([own, *(others[j] for j, _ in self._of)])
        return np.repeat(column[:, None], self._rows.shape[1], axis=1)

    def combine(self, weights: Array, out: Array) -> None:
        """out = the weighted sum of all rows, own first, neighbours in ascending order of id."""
        np.multiply(self._rows, weights, self._terms)
        sum_rows(self._terms, out)
