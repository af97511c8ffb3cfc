"""Where the processes of a run are: on the hosts of the topology, or in a Kubernetes cluster. Pure."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Mapping
from dataclasses import dataclass

from duio_mesh.errors import ScenarioError
from duio_mesh.scenario.model import Host, Scenario

ANYWHERE = "0.0.0.0"  # noqa: S104  (inside a pod, whose address nobody knows before it is there)
LOCAL = "127.0.0.1"
PORT = 7447


@dataclass(frozen=True)
class Place:
    """Where one process is."""

    host: str  # of the topology; "" where that does not matter
    listen: str  # address:port
    dial: str  # address:port under which the others reach it
    names: tuple[str, ...]  # what its certificate has to name


@dataclass(frozen=True)
class Sites:
    """Where everybody is, and how they reach each other."""

    places: Mapping[str, Place]  # by process
    routers: Mapping[str, Place]  # by router; none where processes dial each other
    via: Mapping[str, str]  # router -> the router that it dials; the first dials nobody
    behind: Mapping[str, str]  # process -> its router

    @property
    def record(self) -> bool:
        """Whether there is a recorder."""
        return "recorder" in self.places

    def reached(self, router: str) -> dict[str, tuple[str, ...]]:
        """Direct neighbour of a router -> the processes that are reached through it."""
        near: dict[str, list[str]] = {r: [self.via[r]] if r in self.via else [] for r in self.routers}
        for r, other in self.via.items():
            near[other].append(r)

        def beyond(r: str, origin: str) -> list[str]:
            own = [who for who, mine in self.behind.items() if mine == r]
            return own + [who for other in near[r] if other != origin for who in beyond(other, r)]

        own = {who: (who,) for who, mine in self.behind.items() if mine == router}
        return own | {other: tuple(sorted(beyond(other, router))) for other in near[router]}


def on_hosts(scenario: Scenario) -> Sites:
    """The processes on the hosts that the topology names. Raises ScenarioError when it names none."""
    if not (hosts := scenario.hosts.by_name):
        raise ScenarioError(["hosts: are missing; a compose file is for the processes of one host (docs/deploy.md)"])
    places: dict[str, Place] = {}
    routers: dict[str, Place] = {}
    for name, host in hosts.items():
        if scenario.hosts.routed:
            routers[f"router-{name}"] = _at(name, host, host.port)
            places |= dict.fromkeys(host.runs, Place(name, "", "", (host.address,)))
        else:
            places |= {who: _at(name, host, host.port + k) for k, who in enumerate(host.runs)}
    return Sites(places, routers, *_tree(scenario))


def in_cluster(scenario: Scenario) -> Sites:
    """The processes as pods that reach each other by the names of their services, on hosts if the topology has them."""
    host_of = {who: name for name, host in scenario.hosts.by_name.items() for who in host.runs}
    everybody = tuple(host_of) or ("plant", "recorder", *(f"node-{i}" for i in scenario.nodes))
    routers = {}
    if scenario.hosts.routed:
        routers = {f"router-{name}": _in_pod(scenario, f"router-{name}", name) for name in scenario.hosts.by_name}
    places = {who: _in_pod(scenario, who, host_of.get(who, "")) for who in everybody}
    return Sites(places, routers, *_tree(scenario))


def object_name(scenario: Scenario, who: str) -> str:
    """What the objects of one process are called in a cluster: at most 63 letters, digits and '-'."""
    name = re.sub("[^a-z0-9]+", "-", scenario.name.lower())[:12].strip("-")
    return f"duio-{name}-{who}".replace("--", "-")


def _tree(scenario: Scenario) -> tuple[dict[str, str], dict[str, str]]:
    if not scenario.hosts.routed:
        return {}, {}
    hosts = scenario.hosts.by_name
    via = {f"router-{name}": f"router-{host.via}" for name, host in hosts.items() if host.via}
    return via, {who: f"router-{name}" for name, host in hosts.items() for who in host.runs}


def _at(name: str, host: Host, port: int) -> Place:
    own = ipaddress.ip_address(host.listen)
    local = (LOCAL if own.version == 4 else "::1") if own.is_unspecified else host.listen
    names = tuple(dict.fromkeys((host.address, local)))  # the second is where a health probe asks
    return Place(name, f"{_bracketed(host.listen)}:{port}", f"{_bracketed(host.address)}:{port}", names)


def _in_pod(scenario: Scenario, who: str, host: str) -> Place:
    service = object_name(scenario, who)
    return Place(host, f"{ANYWHERE}:{PORT}", f"{service}:{PORT}", (service, LOCAL))


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address
