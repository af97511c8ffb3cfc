"""Who may not speak: strangers, thieves of keys, and a neighbour that turns bad. Nothing they say moves an estimate."""

from __future__ import annotations

import json
import random
import socket
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest
import zenoh

import duio_mesh
from duio_mesh import credentials
from duio_mesh.mesh import Encoder, Keys, Mesh, security
from duio_mesh.spec import Guard, Wire
from tests.conftest import wait_for
from tests.security.rogue import BETWEEN, ME, VICTIM, Siege, besiege, design_of

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

RANDOM = 100_000
HUGE = 100_000_000
GROWTH = 30_000_000  # bytes that the victim's memory may grow by under all this
LIE = np.full(9, 1e3)
LIES = (BETWEEN + 2, BETWEEN + 3)  # steps that the forged frames claim: soon due, so they would be used


def stranger(endpoint: str, changes: dict[str, Any]) -> zenoh.Session | None:
    """A session of somebody else to this endpoint, or None when it is not let in."""
    return opened({"listen/endpoints": [], "connect/endpoints": [endpoint]} | changes)


def opened(changes: dict[str, Any]) -> zenoh.Session | None:
    """A session with these settings, or None when it cannot connect."""
    config = zenoh.Config()
    plain: dict[str, Any] = {
        "mode": "peer",
        "connect/timeout_ms": 400,
        "connect/exit_on_failure": True,
        "open/return_conditions/connect_scouted": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in (plain | changes).items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError:
        return None


def shout(session: zenoh.Session, siege: Siege) -> None:
    """Say perfect frames of every process that the victim hears, on their keys."""
    for k in LIES:
        session.put(siege.keys.edge(1, 2), siege.forged("node-1", k))
        session.put(siege.keys.edge(3, 2), siege.forged(ME, k))
        session.put(siege.keys.plant(2), siege.forged("plant", k))
    session.close()


def papers(wire: Wire) -> dict[str, Any]:
    """What the owner of these credentials tells Zenoh about them."""
    return {k: v for k, v in security.settings(wire).items() if k.startswith(("transport/link/tls", "transport/auth"))}


def foreign(siege: Siege, mode: str) -> dict[str, Any]:
    """Credentials of node 3 of another run, with another authority."""
    folders = credentials.issue(Path("other"), mode, "0ther", {ME: ("node-2",), "node-2": ()}, "127.0.0.1")
    guard = Guard(mode, ME, str(folders[ME]), (), (), (), 1)
    return papers(Wire("0ther", (), (), guard))


def test_the_attack_works_on_an_open_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the other tests refuse is worth refusing: without security a node can speak for another."""
    design = design_of("open")

    def attack(siege: Siege) -> None:
        for k in LIES:
            siege.put(siege.keys.edge(1, 2), siege.forged("node-1", k))

    trace, _ = besiege(design, attack, monkeypatch)
    assert trace.xhat.tobytes() != duio_mesh.simulate(design).xhat.tobytes()


@pytest.mark.parametrize("mode", ["mtls", "password"])
def test_nothing_that_intruders_say_moves_an_estimate(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    design, draw = design_of(mode), random.Random(1)
    counts: dict[str, int] = {}

    def attack(siege: Siege) -> None:
        endpoint, wire = siege.specs[VICTIM].wire.listen[0], siege.specs[ME].wire
        own = papers(wire)
        name = security.identity(wire.run, ME)
        # from outside
        assert stranger(endpoint, {}) is None
        if mode == "mtls":
            tls = own["transport/link/tls"]
            only_authority = {"root_ca_certificate": tls["root_ca_certificate"]}
            assert stranger(endpoint, {"transport/link/tls": only_authority}) is None
            assert stranger(endpoint.replace("tls", "tcp"), {}) is None
        assert stranger(endpoint, foreign(siege, mode)) is None
        # with what was stolen from node 3: not beside node 3 itself, not as another, and under a new id without rights
        assert stranger(endpoint, own | {"id": name}) is None
        for other in ("node-1", "plant"):  # which the victim has dialled itself
            assert stranger(endpoint, own | {"id": security.identity(wire.run, other)}) is None
        thief = stranger(endpoint, own | {"connect/timeout_ms": 10_000})
        assert thief is not None
        shout(thief, siege)
        host, port = endpoint.split("/")[1].split(":")
        for _ in range(50):  # not even Zenoh's or TLS' language
            with socket.create_connection((host, int(port))) as raw:
                raw.sendall(draw.randbytes(2000))
        # as node 3 itself: what is not its own to say ...
        for k in LIES:
            siege.put(siege.keys.edge(1, 2), siege.forged("node-1", k))
            siege.put(siege.keys.edge(4, 1), siege.forged("node-4", k))
            siege.put(siege.keys.plant(2), siege.forged("plant", k))
            siege.put(siege.keys.credit(1), siege.forged("node-1", 10**6, 0))
        # ... and on its own edge what is not a frame of this run, this source, or any frame at all
        before = siege.memory()
        old = Encoder("0ldrun00", ME)
        for k in LIES:
            siege.put(siege.keys.edge(3, 2), old(k, 0, LIE))
        most = 0
        for n in range(RANDOM):
            siege.put(siege.keys.edge(3, 2), draw.randbytes(draw.randrange(200)))
            if n % 10_000 == 0:
                most = max(most, siege.memory())
        for _ in range(3):
            siege.put(siege.keys.edge(3, 2), bytes(HUGE))
            most = max(most, siege.memory())
        counts["growth"] = most - before

    trace, refused = besiege(design, attack, monkeypatch)
    assert trace.xhat.tobytes() == duio_mesh.simulate(design).xhat.tobytes()
    assert sum(refused.pop(VICTIM).values()) == RANDOM + len(LIES)  # every one came, and was refused
    assert not any(refused.values())  # nobody else was even reached
    assert counts["growth"] < GROWTH


def test_a_key_is_refused_where_it_arrives_even_if_its_subscriber_was_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second line: a victim that shows all its subscriptions still takes only what is meant for it.

    And matching says yes although the data are denied, which is why the start barrier has keys of its own.
    """
    folders = credentials.issue(tmp_path / "keys", "mtls", "r", {VICTIM: (), ME: (VICTIM,)}, "127.0.0.1")
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind(("127.0.0.1", 0))
    endpoint = f"tls/127.0.0.1:{held.getsockname()[1]}"
    mine = Guard("mtls", VICTIM, str(folders[VICTIM]), (ME,), (ME,), (), 10**6)
    theirs = Guard("mtls", ME, str(folders[ME]), (VICTIM,), (VICTIM,), (VICTIM,), 10**6)
    talkative = security.access(Keys("r"), mine)
    talkative["rules"].append(
        {"id": "all", "permission": "allow", "flows": ["egress"], "messages": ["declare_subscriber"]}
        | {"key_exprs": ["**"]}
    )
    talkative["policies"].append({"rules": ["all"], "subjects": [ME]})
    access = {VICTIM: talkative, ME: {"enabled": False}}
    monkeypatch.setattr(security, "access", lambda keys, guard: access[guard.who])
    heard = SimpleQueue[str]()
    keys = Keys("r")

    def keep(sample: Any) -> None:
        heard.put(str(sample.key_expr))

    with Mesh(Wire("r", (endpoint,), (), mine), VICTIM) as victim, held:
        for key in (keys.edge(1, 2), keys.edge(3, 2)):
            victim.subscribe(key, zenoh.handlers.Callback(keep, indirect=False), None)
        with Mesh(Wire("r", (), (endpoint,), theirs), ME) as thief:
            lie = thief._session.declare_publisher(keys.edge(1, 2))
            truth = thief._session.declare_publisher(keys.edge(3, 2))
            wait_for(lambda: lie.matching_status.matching and truth.matching_status.matching)
            lie.put(b"I am node 1")
            truth.put(b"I am node 3")  # behind it on the same link
            assert heard.get(timeout=10) == keys.edge(3, 2)
    assert heard.empty()


@pytest.mark.parametrize("first", ["node-1", ME])
def test_a_member_cannot_slip_into_the_link_of_another(first: str, tmp_path: Path) -> None:
    """Node 3, which node 4 dials, claims the id of node 1, which node 4 dials, too: one of them stays outside."""
    others = ("node-1", ME)
    dials: dict[str, tuple[str, ...]] = {"node-1": (), ME: (), "node-4": others}
    folders = credentials.issue(tmp_path / "keys", "mtls", "r", dials, "127.0.0.1")
    ports = {who: socket.socket() for who in others}
    for held in ports.values():
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
    at = {who: f"tls/127.0.0.1:{held.getsockname()[1]}" for who, held in ports.items()}

    def settings(who: str) -> dict[str, Any]:
        peers = ("node-4",) if who in others else others
        guard = Guard("mtls", who, str(folders[who]), peers, peers, dials[who], 10**6)
        return security.settings(Wire("r", (), (), guard)) | {"listen/endpoints": [at[who]] if who in at else []}

    honest = opened({"connect/endpoints": []} | settings("node-1"))
    mask = {"connect/endpoints": [], "id": security.identity("r", "node-1"), "access_control": {"enabled": False}}
    rogue = opened(settings(ME) | mask)
    order = sorted(others, key=lambda who: who != first)
    waiting = {"connect/endpoints": [at[who] for who in order], "connect/exit_on_failure": False}
    victim = opened(settings("node-4") | waiting)
    assert honest
    assert rogue
    assert victim
    wait_for(lambda: len(victim.info.links()) > 0)
    assert len(victim.info.links()) == 1
    for session in (victim, rogue, honest):
        session.close()
    for held in ports.values():
        held.close()


def test_who_has_no_callers_lets_nobody_in(tmp_path: Path) -> None:
    """An empty list of passwords is not an open door."""
    folders = credentials.issue(tmp_path / "keys", "password", "r", {"node-9": ()}, "127.0.0.1")
    with socket.socket() as held:
        held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        held.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{held.getsockname()[1]}"
        guard = Guard("password", "node-9", str(folders["node-9"]), (), (), (), 10**6)
        with Mesh(Wire("r", (endpoint,), (), guard), "node-9"):
            assert stranger(endpoint, {}) is None
            assert stranger(endpoint, {"transport/auth/usrpwd": {"user": "nobody", "password": "x"}}) is None
