"""The examples of the seed papers as (C_i, A, unknown-input matrix) per node."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

TOPOLOGIES = Path(__file__).parents[2] / "topologies"


def uio_pairs(topology: str) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Per node (C_i, P_i A), P_i = I - B_i (C_i B_i)^+ C_i over all inputs that node i is not told (seed 000)."""
    read = YAML(typ="safe").load
    file = read(TOPOLOGIES / topology)
    plant = read(TOPOLOGIES / file["plant"])
    A, B, E = (np.array(plant[k], dtype=float) for k in "ABE")
    pairs = {}
    for i, node in file["nodes"].items():
        C = np.array(node["C"], dtype=float)
        hidden = [j for j, name in enumerate(plant["inputs"]) if name not in node.get("knows", [])]
        unknown = np.hstack([B[:, hidden], E])
        pairs[i] = C, A - unknown @ np.linalg.pinv(C @ unknown) @ C @ A
    return pairs


# seed 002, section 4 (the input split as corrected: u_i is known, every other input is not)
SIX_A = np.array(
    [
        [0.9925, 0.1496, 0.0037, 0.0001, 0, 0],
        [-0.0998, 0.9925, 0.0498, 0.0024, 0, 0],
        [0, 0, 0.9928, 0.0949, 0, 0],
        [0, 0, -0.1424, 0.8978, 0, 0],
        [0.0002, -0.0056, -0.0037, 0.0472, 0.9850, -0.1493],
        [-0.0037, 0.0744, 0.0016, 0.0049, 0.1990, 0.9850],
    ]
)
SIX_B = np.array(
    [
        [0.0037, 0.0499, 0, 0, 0.0497, 0.0069],
        [0, 0, 0.0024, 0.0475, 0.0012, 0.0001],
        [0.0001, 0.0012, 0.0499, -0.0036, -0.0038, 0.0498],
    ]
).T
SIX_C = {
    1: np.array([[1.0, 0, 0, 0, 0, 0]]),
    2: np.array([[0, 1.0, 0, 0, 0, 0]]),
    3: np.array([[0, 0, 1.0, 0, 0, 0]]),
    4: np.array([[0, 0, 0, 1.0, 0, 1.0]]),
}
SIX_UNKNOWN = {1: [0, 2], 2: [1], 3: [0, 1], 4: [0]}

# seed 003, section V-B
GEO_A = np.array(
    [
        [0, 3.0, 0, 0, 0, 0],
        [-2, 0, 1, 0, 0, 0],
        [0, 0, 0, 2, 0, 0],
        [0, 0, -3, -2, 0, 0],
        [0, 0, 0, 1, 0, -3],
        [0, 2, 0, 0, 4, 0],
    ]
)
GEO_B = np.array([[0, 1.0, 0, 0, 0, 1], [0, 0, 0, 1, 0, 0], [0, 0, 1, 0, 0, 1]]).T
GEO_C = {
    1: np.array([[1.0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]]),
    2: np.array([[0, 1.0, 0, 0, 1, 0]]),
    3: np.array([[0, 0, 1.0, 0, 0, 0], [0, 1, 0, 0, 0, 0]]),
    4: np.array([[1.0, 1, 0, 0, 0, 0]]),
}
GEO_UNKNOWN = {1: [2], 2: [1], 3: [0], 4: [1, 2]}
