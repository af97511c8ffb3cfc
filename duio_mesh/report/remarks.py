"""Where messages can be missing: which estimates the nodes mark, who was away, and what to say beside the verdict.

The verdict compares with the truth, which only a simulation has. A node that marks its estimate says what can be known
without it, so a run that converged and ends with marked estimates is never reported as converged without that word.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from duio_mesh.report.pairing import runs
from duio_mesh.trace import Trace


def presence(trace: Trace) -> dict[int, dict[str, Any]]:
    """Of every node, by its id: ``flagged`` estimates, ``flagged_last`` (so many of its newest ones in a row), and
    ``lost``, the spans [first, after] without an estimate. Empty where no message can be missing.
    """
    if trace.flagged is None:
        return {}
    found = {}
    for i, flags, lost in zip(trace.node_ids.tolist(), trace.flagged, trace.lost, strict=True):
        own = flags[~lost]
        good = np.flatnonzero(~own)
        found[i] = {
            "flagged": int(own.sum()),
            "flagged_last": len(own) - 1 - int(good[-1]) if len(good) else len(own),
            "lost": [list(span) for span in runs(np.flatnonzero(lost))],
        }
    return found


def present(trace: Trace) -> NDArray[np.bool_]:
    """(N,) whether a node is there at the end."""
    lost = trace.lost
    return ~lost[:, -1] if lost.shape[1] else np.ones(len(lost), dtype=bool)


def remarks(trace: Trace) -> list[str]:
    """What has to be said beside the verdict, in words: who flags its newest estimates, who is gone at the end."""
    own, there = presence(trace), dict(zip(trace.node_ids.tolist(), present(trace).tolist(), strict=True))
    flagging, gone = dict[int, list[int]](), dict[int, list[int]]()
    for i, figures in own.items():
        if not there[i]:
            gone.setdefault(figures["lost"][-1][0], []).append(i)
        elif figures["flagged_last"]:
            flagging.setdefault(figures["flagged_last"], []).append(i)
    said = []
    for count, ids in sorted(flagging.items()):
        one = len(ids) == 1
        estimates = "estimate" if count == 1 else f"{count} estimates"
        said.append(f"{_named(ids)} {'flags its' if one else 'flag their'} last {estimates}")
    for k, ids in sorted(gone.items()):
        said.append(f"{_named(ids)} {'is' if len(ids) == 1 else 'are'} gone from step {k} on and not judged")
    return said


def _named(ids: list[int]) -> str:
    if len(ids) == 1:
        return f"node {ids[0]}"
    return f"nodes {', '.join(map(str, ids[:-1]))} and {ids[-1]}"
