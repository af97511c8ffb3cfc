"""What a router lets pass: from the tree of routers to Zenoh's settings. Pure: names in, plain data out.

The routers of a run form a tree. So every process is behind exactly one neighbour of a router, and the router takes a
message only from the side where its sender is, and hands it on only to the side where its receiver is.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.rules import Grant, Party, data_key, identity, listed, probe, subscriptions
from duio_mesh.spec import Guard


def passage(keys: Keys, guard: Guard) -> dict[str, Any]:
    """Zenoh's ``access_control`` of the router ``guard.who``."""
    parties: dict[str, Party] = {}
    for neighbour in guard.behind:
        certified = {"cert_common_names": [neighbour]}
        parties[neighbour] = Party(
            {**certified, "zids": [identity(keys.run, neighbour)]}, list(_granted(keys, guard, neighbour))
        )
        if guard.behind[neighbour] == (neighbour,):  # a process of this host: we are where its probe asks
            parties[f"{neighbour} probe"] = probe(keys, neighbour, certified)
    if guard.probed:
        parties[f"{guard.who} probe"] = probe(keys, guard.who, {"cert_common_names": [guard.who]})
    return listed(parties)


def _granted(keys: Keys, guard: Guard, neighbour: str) -> Iterator[Grant]:
    """All that may pass between a router and its neighbour, a process or another router."""
    near = {*guard.behind[neighbour]}
    heard = [(s, t) for s, t in guard.pairs if s in near and t not in near]
    told = [(s, t) for s, t in guard.pairs if s not in near and t in near]
    if heard:
        yield "ingress", "put", [data_key(keys, s, t) for s, t in heard]
        yield "egress", "declare_subscriber", [key for s, t in heard for key in subscriptions(keys, s, t)]
    if told:
        yield "egress", "put", [data_key(keys, s, t) for s, t in told]
        yield "ingress", "declare_subscriber", [key for s, t in told for key in subscriptions(keys, s, t)]
    yield "ingress", "liveliness_token", [keys.alive(f"{who}/**") for who in sorted(near)]
    far = {who for there in guard.behind.values() for who in there} - near
    if far:
        yield "egress", "liveliness_token", [keys.alive(f"{who}/**") for who in sorted(far)]
    for flow in ("ingress", "egress"):
        yield flow, "declare_liveliness_subscriber", [keys.alive("**")]
