"""One process of the MPI ring: `mpiexec -n 4 python bench/mpi_ring.py ROUNDS SIZE` prints its rounds per second."""

from __future__ import annotations

import sys
import time

import numpy as np
from mpi4py import MPI

rounds, size = int(sys.argv[1]), int(sys.argv[2])
ring = MPI.COMM_WORLD.Create_cart([MPI.COMM_WORLD.size], periods=[True])
sent = np.zeros(size + 1)
received = np.zeros((2, size + 1))
ring.Barrier()
begin = time.perf_counter()
for k in range(rounds):
    sent[0] = k
    ring.Neighbor_allgather(sent, received)
    if received[0, 0] != k or received[1, 0] != k:
        raise SystemExit(f"rounds {received[:, 0]} instead of {k}")
rate = ring.allreduce(rounds / (time.perf_counter() - begin), MPI.MIN)
if ring.rank == 0:
    print(rate)
