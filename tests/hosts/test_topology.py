"""`hosts` and `transport` in the topology file: what they mean, and what is said of mistakes."""

from __future__ import annotations

from pathlib import Path

import pytest

import duio_mesh
from duio_mesh.deploy.places import in_cluster, on_hosts
from duio_mesh.errors import ScenarioError
from duio_mesh.scenario.model import Hosts, Scenario
from tests.conftest import TOPOLOGIES

TEXT = (TOPOLOGIES / "three_hosts.yaml").read_text().replace("plants/", f"{TOPOLOGIES}/plants/")
HALL, NORTH, SOUTH = "runs: [plant, recorder, 1]}", "runs: [2, 3]}", "runs: [4]}"


def load(*changes: tuple[str, str]) -> Scenario:
    text = TEXT
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    Path("t.yaml").write_text(text)
    return duio_mesh.load_scenario("t.yaml")


def test_hosts_as_they_are_read() -> None:
    hosts = load(("transport: direct", "transport: routed"), (SOUTH, "runs: [4], via: north, port: 9000}")).hosts
    assert hosts.routed
    assert list(hosts.by_name) == ["hall", "north", "south"]
    assert hosts.by_name["hall"].runs == ("plant", "recorder", "node-1")
    assert [host.via for host in hosts.by_name.values()] == ["", "hall", "north"]
    assert [host.port for host in hosts.by_name.values()] == [7447, 7447, 9000]
    assert duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml").hosts == Hosts()


def test_every_process_has_a_port_of_its_own() -> None:
    places = on_hosts(load()).places
    assert {who: place.dial for who, place in places.items()} == {
        "plant": "10.80.0.1:7447",
        "recorder": "10.80.0.1:7448",
        "node-1": "10.80.0.1:7449",
        "node-2": "10.80.0.2:7447",
        "node-3": "10.80.0.2:7448",
        "node-4": "10.80.0.3:7447",
    }


def test_a_name_is_dialled_and_any_address_listened_on() -> None:
    sites = on_hosts(load(("10.80.0.2", "north.example"), ("10.80.0.3", '"fd00::3"')))
    assert (sites.places["node-2"].listen, sites.places["node-2"].dial) == ("0.0.0.0:7447", "north.example:7447")
    assert sites.places["node-2"].names == ("north.example", "127.0.0.1")  # the second is where its probe asks
    assert sites.places["node-4"].dial == "[fd00::3]:7447"
    assert sites.places["node-4"].names == ("fd00::3",)


def test_names_in_a_cluster_are_names_there() -> None:
    long = load(("name: three-hosts", "name: Three.Hosts_with-a-long-name"), ("south:", f"{'s' * 30}:"))
    for who in (*in_cluster(long).places.values(),):
        assert len(who.names[0]) <= 63
        assert who.names[0] == who.names[0].lower()
        assert "." not in who.names[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((NORTH, "runs: [2]}"), "36:3: hosts: should run everybody, but no host runs 3"),
        ((HALL, "runs: [recorder, 1]}"), "hosts: should run everybody, but no host runs plant"),
        ((SOUTH, "runs: [4, 2]}"), "38:41: hosts.south.runs.1: 2 already runs on north"),
        ((SOUTH, "runs: [4, 7]}"), "hosts.south.runs.1: no such node: 7; the nodes are 1, 2, 3 and 4"),
        ((SOUTH, "runs: [4, planet]}"), "(did you mean plant?)"),
        ((SOUTH, "runs: []}"), "hosts.south.runs: should have at least 1 entry, not 0"),
        ((SOUTH, "runs: [4], via: hall}"), "hosts.south.via: belongs to transport: routed"),
        (("10.80.0.3", "0.0.0.0"), "hosts.south.address: is what others dial, and nobody can dial 0.0.0.0"),
        (("10.80.0.3", "not a name"), "hosts.south.address: should be an IP address or a name"),
        (("10.80.0.3", "10.80.0.3, listen: lo"), "hosts.south.listen: should be an IP address of this host, not 'lo'"),
        (("10.80.0.3", "10.80.0.2"), "hosts.south: port 7447 of 10.80.0.2 is already used by north"),
        (("10.80.0.3", "10.80.0.3, port: 0"), "hosts.south.port: should be at least 1, not 0"),
        ((NORTH, "runs: [2, 3], port: 65535}"), "hosts.north.port: leaves no room for the ports of 2 processes"),
        (("south:", "South:"), "hosts.South: a host's name should be lower-case letters, digits and '-'"),
        (("security: mtls", "security: password"), "security: hosts need mtls: a password hides nothing"),
        (("transport: direct", "transport: roted"), "(did you mean routed?)"),
    ],
)
def test_mistakes(change: tuple[str, str], said: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        load(change)
    assert any(said in problem for problem in refused.value.problems), refused.value.problems


@pytest.mark.parametrize("via", ["south", "nowhere", "hall2"])
def test_a_router_dials_one_of_an_earlier_host(via: str) -> None:
    """So that the routers form a tree."""
    with pytest.raises(ScenarioError, match=r"hosts\.north\.via: should be a host that stands before this one"):
        load(("transport: direct", "transport: routed"), (NORTH, f"runs: [2, 3], via: {via}}}"))


def test_routed_is_about_hosts() -> None:
    with pytest.raises(ScenarioError, match="transport: routed is about hosts that cannot reach each other"):
        duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml", transport="routed")
