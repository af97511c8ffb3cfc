"""Who may speak: from a process' place in the graph to Zenoh's settings. Pure: names in, plain data out.

Every process accepts from each of its direct peers exactly the keys on which that peer has something to tell it, and
lets each of them subscribe to exactly what is meant for it. Everything else is denied, in both directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

from duio_mesh.mesh.keys import Keys
from duio_mesh.spec import AUTHORITY, CERTIFICATE, KEY, PASSWORD, USERS, Guard, Wire

OVERHEAD = 4096  # bytes of a Zenoh message that are not its payload: key expression, headers; far more than needed


def settings(wire: Wire) -> dict[str, Any]:
    """Zenoh's settings by path for this process; {} when everybody may speak (``wire.guard`` is None).

    Raises OSError when the process' own credentials cannot be read, ValueError for a mode that there is not.
    """
    guard = wire.guard
    if guard is None:
        return {}
    if guard.mode not in _LINKS:
        raise ValueError(f"no such security mode: {guard.mode}")
    keys = Keys(wire.run)
    return {
        "id": identity(wire.run, guard.who),
        "access_control": access(keys, guard),
        "low_pass_filter": [
            {"id": "size", "flows": ["ingress"], "messages": ["put"], "key_exprs": ["**"], "size_limit": guard.limit}
        ],
        # With one link per peer Zenoh adds a link that claims the id of a connected peer to that peer's transport,
        # unchecked, when the first of the two was dialled. From two on, a second link has to prove the first one's key.
        "transport/unicast/max_links": 2,
        # what is longer than this is not even put together from its fragments
        "transport/link/rx/max_message_size": guard.limit + OVERHEAD,
        **_LINKS[guard.mode](guard),
    }


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


def _subscriptions(keys: Keys, source: str, target: str) -> list[str]:
    """What ``target`` declares in order to hear ``source``: its data subscriber, and the start barrier's."""
    data = data_key(keys, source, target)
    meets = not (source.startswith("node-") and target == "recorder")  # nobody waits for the recorder but the plant
    return [data, keys.ready(_name(source), _name(target))] if meets else [data]


def access(keys: Keys, guard: Guard) -> dict[str, Any]:
    """Zenoh's ``access_control`` of this process: default deny, one subject and one policy per direct peer."""
    rules: list[dict[str, Any]] = []
    policies = []
    subjects = []
    for peer in sorted({*guard.hears, *guard.tells}):
        own = [
            {"id": f"{peer}: {flow} {message}", "permission": "allow", "flows": [flow], "messages": [message]}
            | {"key_exprs": allowed}
            for flow, message, allowed in _allowed(keys, guard, peer)
        ]
        rules += own
        subjects.append({"id": peer} | _subject(keys.run, guard, peer))
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [peer]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


def _allowed(keys: Keys, guard: Guard, peer: str) -> Iterator[tuple[str, str, list[str]]]:
    """(flow, message, keys) of all that may pass between this process and one of its peers."""
    if peer in guard.hears:
        yield "ingress", "put", [data_key(keys, peer, guard.who)]
        yield "egress", "declare_subscriber", _subscriptions(keys, peer, guard.who)
    if peer in guard.tells:
        yield "egress", "put", [data_key(keys, guard.who, peer)]
        yield "ingress", "declare_subscriber", _subscriptions(keys, guard.who, peer)
    yield "ingress", "liveliness_token", [keys.alive(f"{peer}/**")]
    yield "egress", "liveliness_token", [keys.alive(f"{guard.who}/**")]
    for flow in ("ingress", "egress"):
        yield flow, "declare_liveliness_subscriber", [keys.alive("**")]


def _subject(run: str, guard: Guard, peer: str) -> dict[str, Any]:
    """By what this process knows its peer: all of these must hold.

    A password is shown by who dials, and only to who is dialled: a process that we dial has for us no name but its id.
    """
    known: dict[str, Any] = {"zids": [identity(run, peer)]}
    if guard.mode == "mtls":
        known["cert_common_names"] = [peer]
    elif peer not in guard.dials:
        known["usernames"] = [peer]
    return known


def _mtls(guard: Guard) -> dict[str, Any]:
    own = Path(guard.folder)
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(own / AUTHORITY),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "listen_certificate": str(own / CERTIFICATE),
            "listen_private_key": str(own / KEY),
            "connect_certificate": str(own / CERTIFICATE),
            "connect_private_key": str(own / KEY),
        }
    }


def _password(guard: Guard) -> dict[str, Any]:
    own = Path(guard.folder)
    secret = (own / PASSWORD).read_text()
    return {"transport/auth/usrpwd": {"user": guard.who, "password": secret, "dictionary_file": str(own / USERS)}}


_LINKS = {"mtls": _mtls, "password": _password}
