"""A node's own latest samples, from which it interpolates y and u between ticks."""

from __future__ import annotations

import numpy as np

from duio_mesh.arrays import Array


class History:
    """[y(k); u(k); y(k-1); u(k-1); ...], two or three lags, in one preallocated vector."""

    def __init__(self, size: int, lags: int) -> None:
        self.samples: Array = np.zeros(size * lags)
        self._size = size
        self._lags = lags
        self._seen = 0

    def push(self, y: Array, u: Array) -> bool:
        """Add the sample of this tick; whether there is a tick before it, so an interval to integrate over.

        On the first interval the third sample is missing; extrapolating it on a straight line through the other two
        makes a quadratic interpolation the linear one.
        """
        s, size = self.samples, self._size
        s[size:] = s[:-size]
        s[: y.size] = y
        s[y.size : size] = u
        self._seen += 1
        if self._seen == 2 and self._lags == 3:
            s[2 * size :] = 2 * s[size : 2 * size] - s[:size]
        return self._seen > 1
