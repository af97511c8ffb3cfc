"""A real router with its access list: what a process may not say does not pass, whatever it sends."""

from __future__ import annotations

import dataclasses
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

import duio_mesh
from duio_mesh.deploy.places import on_hosts
from duio_mesh.deploy.wires import SiteWiring
from duio_mesh.mesh import Keys, Mesh
from duio_mesh.mesh.probe import alive
from duio_mesh.mesh.session import configured
from duio_mesh.spec import Wire
from tests.conftest import TOPOLOGIES, wait_for

pytestmark = pytest.mark.mesh


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@pytest.fixture
def wires(tmp_path: Path) -> dict[str, Wire]:
    """All on one host of this machine's loopback, with a router."""
    everybody = ["plant", "recorder", 1, 2, 3, 4]
    hosts = {"one": {"address": "127.0.0.1", "port": free_port(), "runs": everybody}}
    changes = {"hosts": hosts, "transport": "routed", "run.steps": 10}
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "three_hosts.yaml", **changes))
    wiring = SiteWiring(design, on_hosts(design.scenario), keys=tmp_path / "keys", secrets_at="nowhere", start=10.0)
    found = wiring.wires() | {who: spec.wire for who, spec in wiring.routers().items()}
    return {who: with_folder(wire, tmp_path / "keys" / who) for who, wire in found.items()}


def with_folder(wire: Wire, folder: Path) -> Wire:
    assert wire.guard is not None
    return dataclasses.replace(wire, guard=dataclasses.replace(wire.guard, folder=str(folder)))


@contextmanager
def shameless(wire: Wire) -> Iterator[zenoh.Session]:
    """A member with its own credentials and id that has switched its own access list off."""
    config = configured(wire)
    config.insert_json5("access_control", '{"enabled": false}')
    with zenoh.open(config) as session:
        yield session


def test_a_router_carries_nothing_that_a_process_may_not_say(wires: dict[str, Wire]) -> None:
    keys = Keys(wires["plant"].run)
    got: list[bytes] = []
    overheard: list[bytes] = []
    with ExitStack() as stack:
        stack.enter_context(Mesh(wires["router-one"], "router-one"))
        one, two, three = (stack.enter_context(shameless(wires[f"node-{i}"])) for i in (1, 2, 3))
        for key in (keys.edge(2, 1), keys.edge(4, 1), keys.plant(1), keys.edge(3, 2)):
            one.declare_subscriber(key, lambda sample: got.append(sample.payload.to_bytes()))
        three.declare_subscriber("duio/**", lambda sample: overheard.append(sample.payload.to_bytes()))
        three.declare_subscriber(keys.edge(2, 1), lambda sample: overheard.append(sample.payload.to_bytes()))
        honest = two.declare_publisher(keys.edge(2, 1))
        wait_for(lambda: honest.matching_status.matching)
        for key in (keys.edge(2, 1), keys.edge(4, 1), keys.plant(1), keys.alive("node-2"), f"duio/{keys.run}/anything"):
            for _ in range(20):
                three.put(key, b"forged")  # not node 3's to say
        two.put(keys.edge(3, 2), b"forged")  # node 1 may not hear what is for node 2, nor may node 2 say it
        honest.put(b"honest")
        wait_for(lambda: got)
        threading.Event().wait(0.3)
    assert got == [b"honest"]
    assert b"honest" not in overheard  # its own come back to it


def test_a_probe_sees_its_own_process_and_no_other(wires: dict[str, Wire]) -> None:
    with Mesh(wires["router-one"], "router-one") as router, Mesh(wires["node-1"], "node-1") as node:
        assert not alive(wires["node-1"], "node-1", 3.0)  # no token yet
        router.watch()
        node.watch()
        wait_for(lambda: alive(wires["node-1"], "node-1", 3.0))
        assert alive(wires["router-one"], "router-one", 3.0)
        assert not alive(wires["node-2"], "node-2", 3.0)
        assert not alive(wires["node-2"], "node-1", 3.0)  # node 2 asks in node 1's place
    assert not alive(wires["node-1"], "node-1", 0.5)
