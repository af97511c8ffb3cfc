"""The access list of every process against the graph itself, key by key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zenoh

import duio_mesh
from duio_mesh.errors import ScenarioError
from duio_mesh.mesh import Keys, security
from duio_mesh.scenario.model import Security
from duio_mesh.spec import PASSWORD, Guard, Wire
from duio_mesh.synthesis.design import Design
from duio_mesh.wiring import Wiring, check_address
from tests.conftest import TOPOLOGIES

KINDS = ("put", "delete", "declare_subscriber", "liveliness_token", "declare_liveliness_subscriber", "query", "reply")


def wires(topology: str, mode: str) -> tuple[Design, dict[str, Wire]]:
    changes = {"security": mode, "run.steps": 10}
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{topology}.yaml", **changes))
    wiring = Wiring(design, Path("keys").absolute(), record=True)
    try:
        return design, wiring.wires()
    finally:
        wiring.release()


def allowed(access: dict[str, Any], peer: str, flow: str, message: str, key: str) -> bool:
    """Whether the access list lets this pass, as Zenoh reads it: default deny, any matching rule allows."""
    assert access["default_permission"] == "deny"
    subject = next((s["id"] for s in access["subjects"] if s["id"] == peer), None)
    granted = {rule for policy in access["policies"] if subject in policy["subjects"] for rule in policy["rules"]}
    return any(
        rule["id"] in granted
        and flow in rule["flows"]
        and message in rule["messages"]
        and any(zenoh.KeyExpr(e).includes(zenoh.KeyExpr(key)) for e in rule["key_exprs"])
        for rule in access["rules"]
    )


@pytest.mark.parametrize("topology", ["ring", "augmented_directed"])
def test_every_process_takes_exactly_what_the_graph_gives_it(topology: str) -> None:
    design, found = wires(topology, "mtls")
    arcs = {(a.source, a.target) for a in design.scenario.graph.arcs}
    run = found["plant"].run
    keys, ids = Keys(run), sorted(design.nodes)
    told = {keys.edge(i, j): (f"node-{i}", f"node-{j}") for i in ids for j in ids if (i, j) in arcs}
    told |= {keys.plant(i): ("plant", f"node-{i}") for i in ids}
    told |= {keys.credit(i): (f"node-{i}", "plant") for i in ids}
    told |= {keys.trace(i): (f"node-{i}", "recorder") for i in ids}
    told |= {keys.truth(): ("plant", "recorder")}
    absent = [keys.edge(i, j) for i in ids for j in ids if (i, j) not in arcs]
    everything = [*told, *absent, f"duio/{run}/**", f"duio/{run}/edge/*/*", "duio/other/plant/1", "@/**"]
    for who, wire in found.items():
        assert wire.guard is not None
        access = security.access(keys, wire.guard)
        for peer in found.keys() - {who}:
            for key in everything:
                hears, tells = told.get(key) == (peer, who), told.get(key) == (who, peer)
                assert allowed(access, peer, "ingress", "put", key) == hears, (who, peer, key)
                assert allowed(access, peer, "egress", "declare_subscriber", key) == hears, (who, peer, key)
                assert allowed(access, peer, "egress", "put", key) == tells, (who, peer, key)
                assert allowed(access, peer, "ingress", "declare_subscriber", key) == tells, (who, peer, key)
                for flow in ("ingress", "egress"):
                    for message in {"delete", "query", "reply"} & {*KINDS}:
                        assert not allowed(access, peer, flow, message, key)


@pytest.mark.parametrize("topology", ["ring", "augmented_directed"])
def test_a_process_may_announce_itself_and_nobody_else(topology: str) -> None:
    _, found = wires(topology, "mtls")
    keys = Keys(found["plant"].run)
    for who, wire in found.items():
        assert wire.guard is not None
        access = security.access(keys, wire.guard)
        for peer in {*wire.guard.hears, *wire.guard.tells}:
            for other in found:
                assert allowed(access, peer, "ingress", "liveliness_token", keys.alive(other)) == (other == peer)
                assert allowed(access, peer, "egress", "liveliness_token", keys.alive(other)) == (other == who)
            assert allowed(access, peer, "ingress", "declare_liveliness_subscriber", keys.alive("*"))


def test_both_ends_of_every_link_agree() -> None:
    """What one may send, the other takes: else the run would wait for ever."""
    _, found = wires("augmented_directed", "password")
    keys = Keys(found["plant"].run)
    lists = {who: security.access(keys, wire.guard) for who, wire in found.items() if wire.guard}
    expressions = {e for access in lists.values() for rule in access["rules"] for e in rule["key_exprs"]}
    for a in lists:
        for b in lists.keys() - {a}:
            for message in KINDS:
                for e in expressions:
                    sent = allowed(lists[a], b, "egress", message, e)
                    assert sent == allowed(lists[b], a, "ingress", message, e), (a, b, message, e)


def test_peers_are_known_by_all_that_they_can_prove() -> None:
    _, found = wires("ring", "mtls")
    for wire in found.values():
        assert wire.guard is not None
        for s in security.access(Keys(wire.run), wire.guard)["subjects"]:
            assert s["cert_common_names"] == [s["id"]]
            assert s["zids"] == [security.identity(wire.run, s["id"])]


def test_only_those_that_call_have_shown_a_password() -> None:
    _, found = wires("ring", "password")
    for who, wire in found.items():
        assert wire.guard is not None
        for s in security.access(Keys(wire.run), wire.guard)["subjects"]:
            calls = who in found[s["id"]].guard.dials  # type: ignore[union-attr]
            assert s.get("usernames") == ([s["id"]] if calls else None)


def test_identities_are_zenoh_ids_and_differ() -> None:
    names = [security.identity(run, who) for run in ("a", "b") for who in ("plant", "node-1", "node-2")]
    assert len({*names}) == len(names)
    for name in names:
        config = zenoh.Config()
        config.insert_json5("id", f'"{name}"')


def test_an_open_wire_changes_nothing_and_an_unknown_mode_is_an_error() -> None:
    assert security.settings(Wire("r", (), ())) == {}
    with pytest.raises(ValueError, match="no such security mode: none"):
        security.settings(Wire("r", (), (), Guard("none", "node-1", "", (), (), (), 1)))
    with pytest.raises(FileNotFoundError, match=PASSWORD):
        security.settings(Wire("r", (), (), Guard("password", "node-1", "nowhere", (), (), (), 1)))


@pytest.mark.parametrize("address", ["0.0.0.0", "192.0.2.1", "::", "tower.example"])
def test_an_open_run_listens_on_this_host_only_unless_asked_for_by_name(address: str) -> None:
    with pytest.raises(ScenarioError, match=f"listening on {address}.*exposed: true"):
        check_address(address, Security())
    for fine in (Security(exposed=True), Security("password"), Security("mtls")):
        check_address(address, fine)


@pytest.mark.parametrize("address", ["127.0.0.1", "127.3.2.1", "::1", "localhost"])
def test_this_host_is_always_allowed(address: str) -> None:
    check_address(address, Security())
