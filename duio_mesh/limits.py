"""Whether this shell allows as many open files as a run of so many nodes needs."""

from __future__ import annotations

import resource

from duio_mesh.errors import RunError

SPARE = 48  # open files of a process beside its links


def check_files(nodes: int) -> None:
    """Raise RunError where plant and recorder could not have a link to every node, and the launcher a port for it."""
    needed, (allowed, most) = nodes + SPARE, resource.getrlimit(resource.RLIMIT_NOFILE)
    if allowed != resource.RLIM_INFINITY and allowed < needed:
        way = f"ulimit -n {needed}"
        if most != resource.RLIM_INFINITY and most < needed:
            way += f", which needs a higher hard limit (now {most}: /etc/security/limits.conf)"
        raise RunError(
            f"a run of {nodes} nodes needs {needed} open files in the plant's process, and {allowed} are allowed: {way}"
        )
