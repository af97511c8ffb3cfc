"""What the scenario's measurement noise means for a linear error recursion."""

from __future__ import annotations

import numpy as np

from duio_mesh.arrays import Array
from duio_mesh.scenario.model import Noise


def noise_covariance(noise: Noise) -> Array:
    """(p, p): covariance of the white part (``normal`` terms) of v_i as it enters y_i."""
    variances = [
        sum(p["std"] ** 2 for term in s for kind, p in term.items() if kind == "normal") for s in noise.signals
    ]
    return np.asarray(noise.channel * np.array(variances, dtype=np.float64) @ noise.channel.T)
