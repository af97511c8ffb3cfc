"""Runs over three hosts: network namespaces, each with its own address; containers as the export describes them."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import duio_mesh
from duio_mesh.deploy import command
from duio_mesh.deploy.gather import gather
from duio_mesh.deploy.stored import write_design
from duio_mesh.errors import RunError
from duio_mesh.synthesis.design import Design
from tests.conftest import TOPOLOGIES, wait_for
from tests.hosts.network import SWITCH, Network, need_namespaces

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

SITE = Path("site")


@pytest.fixture(autouse=True)
def _namespaces() -> Iterator[None]:
    need_namespaces()
    yield
    assert left() == []


def left() -> list[str]:
    """Our namespaces that are still there."""
    names = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout.split()
    return [name for name in names if name.startswith(f"duio-{os.getpid()}-")]


def exported(steps: int, **changes: object) -> Design:
    """The three-host topology, designed and exported for compose."""
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "three_hosts.yaml", **{"run.steps": steps}, **changes)
    design = duio_mesh.synthesise(scenario)
    write_design(design, SITE)
    assert command.main(["export", str(SITE), "--compose", "--start-within", "60"]) == 0
    return design


def network(design: Design) -> Network:
    return Network({name: host.address for name, host in design.scenario.hosts.by_name.items()})


def collected() -> list[Path]:
    """What an operator copies back: every host's rows."""
    return [path / "rows" for path in sorted((SITE / "compose").iterdir())]


def assert_equals_the_oracle(design: Design, folders: list[Path], out: str = "gathered") -> None:
    _, result = gather(SITE, folders, Path(out))
    oracle = duio_mesh.simulate(design).arrays()
    found = result.trace.arrays()
    assert found.keys() == oracle.keys()
    for name, values in oracle.items():
        assert found[name].tobytes() == values.tobytes(), name
    assert result.warnings == ()
    assert result.metrics["steps"] == design.plant.steps


@pytest.mark.parametrize(("transport", "last"), [("direct", "recorder"), ("routed", "plant")])
def test_a_run_over_three_hosts_equals_the_oracle_bit_for_bit(transport: str, last: str) -> None:
    design = exported(1000, transport=transport)
    with network(design) as hosts:
        if transport == "routed":  # north and south cannot reach each other
            for host in ("north", "south"):
                hosts.at(SWITCH, f"ip link set dev {host} type bridge_slave isolated on")
        hosts.up(SITE / "compose", without=last)  # the others wait
        south = hosts.containers["node-4"]
        wait_for(south.healthy)
        if transport == "direct":
            south.process.send_signal(signal.SIGSTOP)
            assert not south.healthy("--timeout", "1")
            south.process.send_signal(signal.SIGCONT)
            assert south.healthy()
        else:
            wait_for(hosts.containers["router-north"].healthy)
            assert not hosts.reaches("north", "10.80.0.3")
        hosts.up(SITE / "compose")
        assert hosts.ended() == dict.fromkeys(hosts.containers, 0), hosts.said()
    assert_equals_the_oracle(design, collected())
    metrics = json.loads(Path("gathered/metrics.json").read_text())
    assert metrics["rounds"] == 1000
    assert metrics["rejected"] == {}
    # the recorder alone has everything, too: nothing else need be collected where there is no shared disk
    assert_equals_the_oracle(design, [SITE / "compose" / "hall" / "rows" / "recorder"], "from-recorder")


def unrecorded(steps: int, **changes: object) -> Design:
    """The same without a recorder."""
    addresses = {"hall": ["plant", 1], "north": [2, 3], "south": [4]}
    hosts = {name: {"address": f"10.80.0.{k}", "runs": runs} for k, (name, runs) in enumerate(addresses.items(), 1)}
    return exported(steps, hosts=hosts, **changes)


def rows_of_south() -> int:
    path = SITE / "compose" / "south" / "rows" / "node-4" / "node-4.f64"
    return path.stat().st_size // (8 * 9) if path.exists() else 0


def test_a_limited_bandwidth_and_a_link_that_goes_down_and_up_again_are_survived() -> None:
    design = unrecorded(150)
    with network(design) as hosts:
        hosts.limit("south")
        hosts.up(SITE / "compose")
        wait_for(lambda: rows_of_south() > 20)
        hosts.at(SWITCH, "ip link set south down")
        never = threading.Event()
        never.wait(0.5)  # what was on its way has arrived
        before = rows_of_south()
        never.wait(1.0)
        assert rows_of_south() == before < 150  # really down
        hosts.at(SWITCH, "ip link set south up")
        assert hosts.ended() == dict.fromkeys(hosts.containers, 0), hosts.said()
        assert hosts.held_up("south") > 0  # the limit was one
    assert_equals_the_oracle(design, collected())


def test_a_host_that_is_lost_ends_the_run_and_is_named() -> None:
    design = unrecorded(1_000_000, **{"run.deadline": 2.0})
    with network(design) as hosts:
        hosts.up(SITE / "compose")
        wait_for(lambda: rows_of_south() > 50)
        hosts.at(SWITCH, "ip link set south down")
        assert hosts.ended() == dict.fromkeys(hosts.containers, 3), hosts.said()
    with pytest.raises(RunError, match=r"node-1 waited 2 s on edge 4 -> 1 for step \d+, round 0"):
        gather(SITE, collected(), Path("gathered"))
    trace = np.load("gathered/trace.npz")
    assert 50 < len(trace["t"]) < 1_000_000
    run = dataclasses.replace(design.scenario.run, steps=50)
    start = duio_mesh.simulate(duio_mesh.synthesise(dataclasses.replace(design.scenario, run=run)))
    assert trace["xhat"][:, :50].tobytes() == start.xhat.tobytes()


def test_nothing_is_left_of_a_test_that_fails() -> None:
    hosts = network(unrecorded(50))

    def fail() -> None:
        with hosts:
            assert len(left()) == 4
            hosts.up(SITE / "compose", without="plant")  # the others wait for it
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert left() == []
    assert [c.process.returncode for c in hosts.containers.values()] == [-signal.SIGKILL] * 4
