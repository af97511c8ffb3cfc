"""Who may speak: from a process' place in the graph to Zenoh's settings. Pure: names in, plain data out.

Every process accepts from each of its direct peers exactly the keys on which that peer has something to tell it, and
lets each of them subscribe to exactly what is meant for it. Everything else is denied, in both directions.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.passage import passage
from duio_mesh.mesh.rules import Grant, Party, data_key, identity, listed, probe, subscriptions
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
        "access_control": (access if not guard.behind else passage)(keys, guard),
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


def access(keys: Keys, guard: Guard) -> dict[str, Any]:
    """Zenoh's ``access_control`` of this process: what each of the others may say to it and hear from it.

    Where a router stands in between, it stands for all of them: who says what is then for the routers to see to.
    """
    peers = {peer: list(_allowed(keys, guard, peer)) for peer in sorted({*guard.hears, *guard.tells})}
    if guard.through:
        peers = {guard.through: [grant for grants in peers.values() for grant in grants]}
    parties = {peer: Party(_subject(keys.run, guard, peer), grants) for peer, grants in peers.items()}
    if guard.probed and not guard.through:  # else its probe asks the router
        parties[f"{guard.who} probe"] = probe(keys, guard.who, {"cert_common_names": [guard.who]})
    return listed(parties)


def _allowed(keys: Keys, guard: Guard, peer: str) -> Iterator[Grant]:
    """(flow, message, keys) of all that may pass between this process and one of its peers."""
    if peer in guard.hears:
        yield "ingress", "put", [data_key(keys, peer, guard.who)]
        yield "egress", "declare_subscriber", subscriptions(keys, peer, guard.who)
    if peer in guard.tells:
        yield "egress", "put", [data_key(keys, guard.who, peer)]
        yield "ingress", "declare_subscriber", subscriptions(keys, guard.who, peer)
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
