"""The hosts of a topology, checked against its nodes: who runs where, and how the hosts reach each other."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable, Mapping
from typing import Any

from duio_mesh.scenario import model, schema
from duio_mesh.scenario.problems import Path, Problems, did_you_mean, listed
from duio_mesh.scenario.validate import fields

HOSTS: Path = ("hosts",)
SINGLE = ("plant", "recorder")
_NAME = re.compile(
    r"(?=.{1,253}$)[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?)*"
)
_LABEL = re.compile(r"[a-z0-9]([a-z0-9-]{0,28}[a-z0-9])?")  # it becomes part of the names of containers and routers


def read_hosts(
    document: Mapping[str, Any], ids: Iterable[int] | None, security: model.Security, problems: Problems
) -> model.Hosts:
    """The hosts by name in the order of the file; none where the topology has none.

    ``ids``: the nodes of the topology, None when they have a problem of their own.
    """
    written = {key: document[key] for key in schema.Placed.model_fields if document.get(key) is not None}
    found = fields(schema.Placed, written, (), problems)
    hosts: dict[str, schema.Host] | None = found.get("hosts")
    routed = found.get("transport") == "routed"
    if not hosts:
        if routed and "hosts" not in written:
            problems.at(("transport",), "routed is about hosts that cannot reach each other: give hosts, too")
        return model.NO_HOSTS
    if security.mode == "password":
        problems.at(("security",), "hosts need mtls: a password hides nothing on the way from host to host")
    known = {str(i) for i in ids} | {*SINGLE} if ids is not None else None
    _everybody_once(hosts, known, problems)
    built = {}
    for at, (name, host) in enumerate(hosts.items()):
        path = (*HOSTS, name)
        if not _LABEL.fullmatch(name):
            problems.at_key(path, "a host's name should be lower-case letters, digits and '-', at most 30")
        via = _via(name, host, list(hosts)[:at], routed, problems)
        listen = _addresses(host, path, problems)
        count = 1 if routed else len(host.runs)
        if host.port + count > 65536:
            problems.at((*path, "port"), f"leaves no room for the ports of {count} processes")
        built[name] = model.Host(host.address, listen, host.port, tuple(map(_process, host.runs)), via)
    _ports_apart(built, routed, problems)
    return model.Hosts(built, routed)


def _process(who: int | str) -> str:
    return f"node-{who}" if isinstance(who, int) else who


def _everybody_once(hosts: Mapping[str, schema.Host], known: set[str] | None, problems: Problems) -> None:
    at: dict[str, str] = {}
    for name, host in hosts.items():
        for k, who in enumerate(host.runs):
            path = (*HOSTS, name, "runs", k)
            if known is not None and str(who) not in known:
                problems.at(path, f"no such node: {who}; the nodes are {listed(sorted(known - {*SINGLE}), 'and')}")
            elif str(who) in at:
                problems.at(path, f"{who} already runs on {at[str(who)]}")
            at.setdefault(str(who), name)
    nobody = sorted((known or set()) - at.keys() - {"recorder"}, key=lambda who: (len(who), who))
    if nobody:
        problems.at(HOSTS, f"should run everybody, but no host runs {listed(nobody, 'and')}")


def _via(name: str, host: schema.Host, earlier: list[str], routed: bool, problems: Problems) -> str:
    """The host whose router this one's router dials; "" for the first host, and where there are no routers."""
    path = (*HOSTS, name, "via")
    if host.via is None:
        return earlier[0] if routed and earlier else ""
    if not routed:
        problems.at_key(path, "belongs to transport: routed")
    elif host.via not in earlier:
        near = did_you_mean(host.via, earlier)
        problems.at(path, f"should be a host that stands before this one in the file, not {host.via!r}{near}")
    return host.via


def _addresses(host: schema.Host, path: Path, problems: Problems) -> str:
    """The address to listen on; complains of addresses that nobody could dial or listen on."""
    address = _ip(host.address)
    if address is None and not _NAME.fullmatch(host.address):
        problems.at((*path, "address"), f"should be an IP address or a name, not {host.address!r}")
    elif address is not None and address.is_unspecified:
        problems.at((*path, "address"), f"is what others dial, and nobody can dial {host.address} (see listen)")
    if host.listen is not None and _ip(host.listen) is None:
        problems.at((*path, "listen"), f"should be an IP address of this host, not {host.listen!r}")
    return host.listen or (host.address if address is not None else "0.0.0.0")  # noqa: S104  (a name has no other)


def _ip(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _ports_apart(hosts: Mapping[str, model.Host], routed: bool, problems: Problems) -> None:
    """Several hosts may share an address (a first try on one machine), but no two of their processes a port."""
    taken: dict[tuple[str, int], str] = {}
    for name, host in hosts.items():
        for port in range(host.port, host.port + (1 if routed else len(host.runs))):
            other = taken.setdefault((host.address, port), name)
            if other != name:
                problems.at((*HOSTS, name), f"port {port} of {host.address} is already used by {other}")
                break
