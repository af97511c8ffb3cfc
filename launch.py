#!/usr/bin/env python3
"""python launch.py topologies/partitioned.yaml: run a distributed observer as real processes (see --help)."""

import sys

from duio_mesh.cli import main

if __name__ == "__main__":
    sys.exit(main())
