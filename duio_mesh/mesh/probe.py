"""Asks one process, or the router in front of it, whether it is alive."""

from __future__ import annotations

import json
from dataclasses import replace

import zenoh

from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.rules import HEALTH, identity
from duio_mesh.mesh.session import configured
from duio_mesh.spec import Wire

ANY = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104  (listened on; and where that can be dialled)


def alive(wire: Wire, who: str, timeout: float) -> bool:
    """Whether the liveliness token of ``who`` is seen where it has to be: at itself, or at its router.

    The probe shows the process' own credentials and an id of its own. A process that hangs, one that has not yet
    declared its token and one that is not there are not alive.
    """
    endpoint = wire.connect[0] if wire.mode == "client" else wire.listen[0]
    for unspecified, local in ANY.items():
        endpoint = endpoint.replace(f"/{unspecified}:", f"/{local}:")
    config = configured(replace(wire, mode="client", listen=(), connect=(endpoint,), start=timeout))
    if wire.guard:
        config.insert_json5("id", json.dumps(identity(wire.run, who + HEALTH)))
        config.insert_json5("access_control", json.dumps({"enabled": False}))  # the other side's list is what counts
    try:
        with zenoh.open(config) as session:
            replies = session.liveliness().get(Keys(wire.run).alive(who), timeout=timeout)
            return any(reply.ok is not None for reply in replies)
    except zenoh.ZError:
        return False
