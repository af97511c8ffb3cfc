"""The pieces of Zenoh's access lists: who is who, which key is whose, and the list itself. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from hashlib import sha256
from typing import Any, NamedTuple, TypeAlias

from duio_mesh.mesh.keys import Keys

HEALTH = "/health"  # behind a process' name: its health probe, which has that process' credentials but an id of its own

Grant: TypeAlias = tuple[str, str, list[str]]  # (flow, message, keys)


class Party(NamedTuple):
    """Somebody at the other end of a link, by what it can show, and what may pass between us."""

    shows: Mapping[str, Any]
    grants: Iterable[Grant]


def identity(run: str, who: str) -> str:
    """The Zenoh id of a process of a run: 32 hexadecimal digits, the first not 0.

    Zenoh refuses a second peer with the id of one that is connected, so who steals a node's key cannot use it beside
    the node itself.
    """
    return "d" + sha256(f"{run}/{who}".encode()).hexdigest()[:31]


def _name(who: str) -> int | str:
    """node-3 -> 3; plant and recorder stay what they are."""
    return int(who.removeprefix("node-")) if who.startswith("node-") else who


def data_key(keys: Keys, source: str, target: str) -> str:
    """The key on which ``source`` tells ``target``. Raises ValueError when the first has nothing to tell the second."""
    s, t = _name(source), _name(target)
    match s, t:
        case int(), int():
            return keys.edge(s, t)
        case int(), "plant":
            return keys.credit(s)
        case int(), "recorder":
            return keys.trace(s)
        case "plant", int():
            return keys.plant(t)
        case "plant", "recorder":
            return keys.truth()
    raise ValueError(f"{source} has nothing to tell {target}")


def subscriptions(keys: Keys, source: str, target: str) -> list[str]:
    """What ``target`` declares in order to hear ``source``: its data subscriber, and the start barrier's."""
    return [data_key(keys, source, target), keys.ready(_name(source), _name(target))]


def probe(keys: Keys, who: str, shown: Mapping[str, Any]) -> Party:
    """The health probe of ``who``: it may ask whether that one process is alive, and nothing else."""
    alive = [keys.alive(who)]
    shows = {**shown, "zids": [identity(keys.run, who + HEALTH)]}
    return Party(shows, [("ingress", "liveliness_query", alive), ("egress", "liveliness_token", alive)])


def listed(parties: Mapping[str, Party]) -> dict[str, Any]:
    """Zenoh's ``access_control``: default deny, one subject and one policy per party."""
    rules: list[dict[str, Any]] = []
    policies, subjects = [], []
    for name, party in parties.items():
        own = [
            {"id": f"{name}: {flow} {message} {n}", "permission": "allow", "flows": [flow], "messages": [message]}
            | {"key_exprs": allowed}
            for n, (flow, message, allowed) in enumerate(party.grants)
        ]
        rules += own
        subjects.append({"id": name, **party.shows})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }
