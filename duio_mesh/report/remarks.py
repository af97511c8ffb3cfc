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

FEW = 8  # nodes that are named one by one


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
    flagging = {i: figures["flagged_last"] for i, figures in own.items() if there[i] and figures["flagged_last"]}
    gone = dict[int, list[int]]()
    for i in own:
        if not there[i]:
            gone.setdefault(own[i]["lost"][-1][0], []).append(i)
    said = []
    if flagging:
        least, most = min(flagging.values()), max(flagging.values())
        count = f"{least} to {most} estimates" if least < most else "estimate" if most == 1 else f"{most} estimates"
        said.append(f"{_named(list(flagging))} {'flags its' if len(flagging) == 1 else 'flag their'} last {count}")
    for k, ids in sorted(gone.items()):
        said.append(f"{_named(ids)} {'is' if len(ids) == 1 else 'are'} gone from step {k} on and not judged")
    return said


def _named(ids: list[int]) -> str:
    if len(ids) > FEW:
        return f"{len(ids)} nodes"
    return f"node {ids[0]}" if len(ids) == 1 else f"nodes {', '.join(map(str, ids[:-1]))} and {ids[-1]}"
