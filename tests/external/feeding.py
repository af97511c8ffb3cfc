"""What the tests of external plants share: a design, a publisher beside a run, and the observers driven by hand."""

from __future__ import annotations

import csv
import json
import socket
import struct
import threading
from collections.abc import Callable, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import zenoh

import duio_mesh
from duio_mesh.arrays import Array
from duio_mesh.observers import make_observer
from duio_mesh.synthesis.design import Design
from tests.conftest import ROOT, TOPOLOGIES, wait_for

TOPOLOGY = TOPOLOGIES / "external_rooms.yaml"
IDS = (1, 2, 3, 4)


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@cache
def base() -> Design:
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGY))


def design(security: str = "open", given: Design | None = None, **changes: Any) -> tuple[Design, str]:
    """The example's (or the given) design on a port of its own, and that endpoint; ``changes`` are of ``outside``."""
    made, endpoint = given or base(), f"tcp/127.0.0.1:{free_port()}"
    assert made.plant.outside is not None
    outside = replace(made.plant.outside, listen=endpoint, **changes)
    scenario = replace(made.scenario, outside=outside, security=made.scenario.security._replace(mode=security))
    return replace(made, scenario=scenario, plant=replace(made.plant, outside=outside)), endpoint


@cache
def rooms() -> dict[int, Array]:
    """The example's file: node -> (K, p + m), read without the code under test."""
    with (ROOT / "examples" / "rooms.csv").open(newline="") as f:
        head, *rows = csv.reader(f)
    table = np.array(rows, dtype=np.float64)
    return {i: table[:, [at for at, name in enumerate(head) if name.startswith(f"{i}.")]] for i in IDS}


def driven(made: Design, samples: Mapping[int, Array]) -> Array:
    """(N, K, n) estimates of the observers, driven with these samples (K, p + m) in this process."""
    observers = {i: make_observer(made.nodes[i]) for i in IDS}
    xhat: dict[int, list[Array]] = {i: [] for i in IDS}
    for k in range(len(samples[1])):
        for i, observer in observers.items():
            observer.sample(samples[i][k, : made.nodes[i].p], samples[i][k, made.nodes[i].p :])
        for r in range(observers[1].rounds):
            sent = {i: observer.message(r).copy() for i, observer in observers.items()}
            for i, observer in observers.items():
                observer.exchange(r, {j: sent[j] for j in sorted(made.nodes[i].hears)})
        for i, observer in observers.items():
            xhat[i].append(observer.estimate().state.copy())
    return np.array([xhat[i] for i in IDS])


class Outsider:
    """A Zenoh client of the gateway, as somebody else would write it; or a peer behind a router, as a ROS 2 node is."""

    def __init__(self, endpoint: str, mode: str = "client") -> None:
        config = zenoh.Config()
        config.insert_json5("mode", json.dumps(mode))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        config.insert_json5("connect/timeout_ms", "20000")
        config.insert_json5("connect/retry", json.dumps({"period_init_ms": 20, "period_max_ms": 50}))
        self.session = zenoh.open(config)
        self._publishers: dict[str, Any] = {}

    def put(self, key: str, payload: bytes | str, number: int | None = None) -> None:
        """Publish, once somebody is there to hear it."""
        if key not in self._publishers:
            block = zenoh.CongestionControl.BLOCK
            self._publishers[key] = self.session.declare_publisher(key, congestion_control=block)
            wait_for(lambda: self._publishers[key].matching_status.matching)
        attachment = None if number is None else struct.pack("<qqB", number, 0, 16) + bytes(16)  # as rmw_zenoh has it
        self._publishers[key].put(payload, attachment=attachment)

    def row(self, k: int, without: tuple[int, ...] = ()) -> None:
        """Row k of the example's file, as its nodes' samples number k."""
        for i in IDS:
            if i not in without:
                self.put(f"building/{i}/y", json.dumps({"k": k, "y": rooms()[i][k].tolist()}))

    def end(self) -> None:
        self.put("building/end", "")


@contextmanager
def router(endpoint: str) -> Any:
    """A Zenoh router, set up like that of rmw_zenoh: gossip, no multicast."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


@contextmanager
def feeding(endpoint: str, feed: Callable[[Outsider], None], mode: str = "client") -> Any:
    """``feed`` runs beside the body, on a thread and a session of its own; its exception is the test's."""
    wrong: list[BaseException] = []

    def work() -> None:
        try:
            outsider = Outsider(endpoint, mode)
            try:
                feed(outsider)
            finally:
                outsider.session.close()
        except BaseException as e:
            wrong.append(e)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        thread.join(60)
    if wrong:
        raise wrong[0]
