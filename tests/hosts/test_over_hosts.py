"""Runs over three hosts: network namespaces, each with its own address; containers as the export describes them."""

from __future__ import annotations

import json
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
MBIT = 1_000_000 / 8  # bytes per second


@pytest.fixture(autouse=True)
def _namespaces() -> Iterator[None]:
    need_namespaces()
    before = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout
    yield
    assert subprocess.run(["ip", "netns", "list"], capture_output=True, text=True).stdout == before


def exported(steps: int, **changes: object) -> Design:
    """The three-host topology, designed and exported for compose."""
    design = duio_mesh.synthesise(
        duio_mesh.load_scenario(TOPOLOGIES / "three_hosts.yaml", **{"run.steps": steps}, **changes)
    )
    write_design(design, SITE)
    assert command.main(["export", str(SITE), "--compose", "--start-within", "60"]) == 0
    return design


def network(design: Design) -> Network:
    return Network({name: host.address for name, host in design.scenario.hosts.by_name.items()})


def collected(hosts: Network) -> list[Path]:
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


@pytest.mark.parametrize("transport", ["direct", "routed"])
def test_a_run_over_three_hosts_equals_the_oracle_bit_for_bit(transport: str) -> None:
    design = exported(2000, transport=transport)
    with network(design) as hosts:
        if transport == "routed":  # north and south cannot reach each other
            for host in ("north", "south"):
                hosts.at(SWITCH, f"ip link set dev {host} type bridge_slave isolated on")
        hosts.up(SITE / "compose")
        assert hosts.ended() == dict.fromkeys(hosts.containers, 0), hosts.said()
        folders = collected(hosts)
    assert_equals_the_oracle(design, folders)
    metrics = json.loads(Path("gathered/metrics.json").read_text())
    assert metrics["rounds"] == 2000
    assert metrics["rejected"] == {}
    # the recorder alone has everything, too: nothing else need be collected where there is no shared disk
    assert_equals_the_oracle(design, [SITE / "compose" / "hall" / "rows" / "recorder"], "from-recorder")
