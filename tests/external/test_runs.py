"""Runs that are fed from outside, as real processes: the same bits, nothing moved by bad samples, and clear ends."""

from __future__ import annotations

import json
import re
import signal
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

import duio_mesh
from duio_mesh import cli
from duio_mesh.errors import RunError, ScenarioError
from duio_mesh.journal import map_rows
from duio_mesh.spec import NodeSpec, PlantSpec, read_spec, write_spec
from duio_mesh.wiring import Wiring
from tests.conftest import ROOT, wait_for
from tests.external.feeding import IDS, TOPOLOGY, Outsider, base, design, driven, feeding, free_port, rooms, router
from tests.processes.running import Running

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

SHORT = 12  # steps


def shortened() -> dict[int, np.ndarray]:
    return {i: table[:SHORT] for i, table in rooms().items()}


def test_the_documented_example_gives_the_bits_of_its_file() -> None:
    """Two terminals, as docs/sensors.md has it; the publisher's word ends the run long before its last step."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Running(TOPOLOGY.name, "--set", f"external.listen={endpoint}", steps=1000) as run:
        example = [sys.executable, str(ROOT / "examples" / "replay_csv.py"), str(ROOT / "examples" / "rooms.csv")]
        subprocess.run([*example, endpoint, "0"], check=True, timeout=60)
        assert run.end() == 0, run.stderr
    assert "the nodes agree" in run.stdout
    assert "does not prove that they are right" in " ".join(run.stdout.split())
    with np.load(run.out / "trace.npz", allow_pickle=False) as trace:
        assert trace["xhat"].tobytes() == driven(base(), rooms()).tobytes()
        assert np.isnan(trace["x"]).all()
        assert trace["x"].shape == (101, 9)
        assert all(trace[f"sample_{i}"].tobytes() == rooms()[i].tobytes() for i in IDS)
        estimates = trace["xhat"]
    found = run.metrics()
    assert (found["verdict"], found["converged"], found["agree"]) == ("the nodes agree", None, True)
    assert (found["steps"], found["rejected"], found["criterion"]["from_step"]) == (101, {}, 51)
    for at, i in enumerate(IDS):  # the figures, from the trace
        node, late = found["nodes"][str(i)], slice(51, None)
        apart = estimates[at, late] - estimates[:, late].mean(axis=0)
        C = base().scenario.nodes[i].C
        missed = [rooms()[i][late, : len(C)] - estimates[j, late] @ C.T for j in range(4) if j != at]
        assert node["rms"] is None
        assert node["disagreement"] == pytest.approx(np.sqrt(np.mean(apart**2)), rel=1e-12)
        assert node["residual"] == pytest.approx(np.sqrt(np.mean(np.square(missed))), rel=1e-12)
    assert (run.out / "recording.rrd").exists()


def spoil(outsider: Outsider, k: int, run: Path) -> None:
    """Everything that should not count, before row k."""
    y = rooms()[3][k].tolist()
    outsider.put("building/3/y", json.dumps({"k": k, "y": y[:-1]}))
    outsider.put("building/3/y", json.dumps({"k": k, "y": [*y[:-1], float("nan")]}))
    outsider.put("building/3/y", b"\xff\x00 no json")
    outsider.put("building/3/y", json.dumps({"k": max(0, k - 1), "y": y}))
    outsider.put("building/3/y", json.dumps({"y": y}))
    outsider.put("building/9/y", json.dumps({"k": k, "y": y}))
    wire = read_spec(run / "nodes" / "gateway.spec", PlantSpec).wire
    outsider.session.put(f"duio/{wire.run}/plant/3", struct.pack("<4d", *y))  # the mesh's own keys, from outside
    outsider.session.put(f"duio/{wire.run}/edge/2/3", b"\0" * 100)


@pytest.mark.parametrize("security", ["open", "mtls"])
def test_bad_samples_are_counted_and_move_nothing(security: str) -> None:
    made, endpoint = design(security)
    heard: list[str] = []

    def feed(outsider: Outsider) -> None:
        outsider.session.declare_subscriber(
            "**", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
        )
        outsider.row(0)
        for k in range(1, SHORT):
            spoil(outsider, k, Path("run"))
            outsider.row(k)
        outsider.end()

    with feeding(endpoint, feed):
        result = duio_mesh.run(made, "run", record=False)
    assert result.trace.xhat.tobytes() == driven(made, shortened()).tobytes()
    assert result.metrics["steps"] == SHORT
    times = SHORT - 1
    assert result.metrics["rejected"]["gateway"] == {
        "building/3/y: 3 numbers instead of 4": times,
        "building/3/y: not finite": times,
        "building/3/y: not json": times,
        "building/3/y: seen before": times,
        "building/3/y: with a number, and others without": times,
        "other keys: no node of this run has this key": times,
    }
    assert any("refused a sample on building/9/y: no node of this run has this key" in w for w in result.warnings)
    assert heard == [], "the mesh was heard outside"
    assert set(result.metrics["rejected"]) == {"gateway"}


def test_a_sensor_that_never_speaks_ends_the_run_by_its_key() -> None:
    made, endpoint = design(start_within=1.0)

    def feed(outsider: Outsider) -> None:
        outsider.row(0, without=(2, 3))
        outsider.put("building/3/y", "[1, 2]")

    with feeding(endpoint, feed), pytest.raises(RunError) as failed:
        duio_mesh.run(made, "run", record=False)
    text = str(failed.value)
    assert text.startswith("the gateway waited 1 s for the first sample of building/2/y (nothing came), building/3/y ")
    assert "(nothing came; 1 refused: 2 numbers instead of 4)" in text
    assert "building/1/y" not in text
    said = [json.loads(line) for line in Path("run/logs/gateway.jsonl").read_text().splitlines()]
    assert {"waiting for building/2/y, building/3/y"} <= {e.get("text") for e in said}
    assert json.loads(Path("run/metrics.json").read_text())["verdict"] == "incomplete"


def test_a_sensor_that_stops_ends_the_run_by_key_and_number() -> None:
    """The first sample may take longer than any deadline; a later one may not."""
    made, endpoint = design()
    nodes = {i: replace(spec, deadline=1.0) for i, spec in made.nodes.items()}
    made = replace(made, plant=replace(made.plant, deadline=1.0), nodes=nodes)
    over = threading.Event()

    def feed(outsider: Outsider) -> None:
        over.wait(1.5)
        for k in range(5):
            outsider.row(k)
        outsider.row(5, without=(4,))
        outsider.row(6)
        over.wait(30)

    with feeding(endpoint, feed):
        try:
            with pytest.raises(RunError) as failed:
                duio_mesh.run(made, "run", record=False)
        finally:
            over.set()
    expected = "the gateway waited 1 s for step 5 of building/4/y (its sample 5 is missing; the last was number 6)"
    assert str(failed.value).startswith(expected)
    with np.load("run/trace.npz", allow_pickle=False) as trace:
        assert trace["xhat"].tobytes() == driven(made, {i: table[:5] for i, table in rooms().items()}).tobytes()


def test_a_late_sensor_keeps_its_last_value_and_is_counted() -> None:
    made, endpoint = design(hold=0.3)

    def feed(outsider: Outsider) -> None:
        for k in range(SHORT):
            outsider.row(k, without=(2,) if k in (5, 6) else ())
        outsider.end()

    with feeding(endpoint, feed):
        result = duio_mesh.run(made, "run", record=False)
    samples = {i: table.copy() for i, table in shortened().items()}
    samples[2][5:7] = samples[2][4]
    assert result.trace.xhat.tobytes() == driven(made, samples).tobytes()
    assert result.metrics["held"] == {"building/2/y": 2}
    assert "building/2/y: 2 samples were late; the last value before was used" in result.warnings


def test_one_key_for_every_number_in_the_form_of_ros_through_a_router() -> None:
    """Fifteen topics of std_msgs/Float64, one of them heard by two nodes; each publisher counts from its own number."""
    made, endpoint = design()
    names = {i: [f"0/n{i}/v{at}/std_msgs::msg::dds_::Float64_" for at in range(4)] for i in IDS}
    names[2][1] = names[1][1]  # room 6 has one thermometer
    feeds = {i: tuple(f"{name}/*" for name in names[i]) for i in IDS}
    keys = sorted({name for several in names.values() for name in several})
    assert made.plant.outside is not None
    outside = replace(
        made.plant.outside,
        listen="",
        connect=endpoint,
        encoding="std_msgs/Float64",
        feeds=feeds,
        sizes=dict.fromkeys((f"{key}/*" for key in keys), 1),
        strays="",
    )
    made = replace(made, plant=replace(made.plant, outside=outside))
    values = {
        (name, k): rooms()[i][k, at] for i in reversed(IDS) for at, name in enumerate(names[i]) for k in range(SHORT)
    }

    def feed(outsider: Outsider) -> None:
        for k in range(SHORT):
            for n, key in enumerate(keys):
                payload = b"\x00\x01\x00\x00" + struct.pack("<d", values[key, k])
                outsider.put(f"{key}/RIHS01_{n:064x}", payload, number=1 + 7 * n + k)
        outsider.end()

    with router(endpoint), feeding(endpoint, feed, mode="peer"):
        result = duio_mesh.run(made, "run", record=False)
    samples = {i: table.copy() for i, table in shortened().items()}
    samples[2][:, 1] = samples[1][:, 1]
    assert result.trace.xhat.tobytes() == driven(made, samples).tobytes()
    assert result.metrics["rejected"] == {}


def test_processes_started_by_hand() -> None:
    """The gateway and the nodes from their spec files, each by its own command, as a container would."""
    made, endpoint = design()
    wiring = Wiring(made, Path("keys"), record=False)
    wires = wiring.wires()
    specs: dict[str, NodeSpec | PlantSpec] = {f"node-{i}": spec for i, spec in made.nodes.items()} | {
        "gateway": made.plant
    }
    running = {}
    for who, spec in specs.items():
        wire = wires["plant" if who == "gateway" else who]
        write_spec(replace(spec, wire=wire, output=f"{who}.f64"), Path(f"{who}.spec"))
        command = [sys.executable, "-m", f"duio_mesh.{who.split('-')[0]}", "--spec", f"{who}.spec"]
        running[who] = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def feed(outsider: Outsider) -> None:
        for k in range(SHORT):
            outsider.row(k)
        outsider.end()

    with feeding(endpoint, feed):
        said = {who: process.communicate(timeout=60)[0] for who, process in running.items()}
    wiring.release()
    assert {who: process.returncode for who, process in running.items()} == dict.fromkeys(specs, 0), said
    expected = driven(made, shortened())
    for at, i in enumerate(IDS):
        assert map_rows(f"node-{i}.f64", 9).tobytes() == expected[at].tobytes()
    assert map_rows("gateway.f64", 16).tobytes() == np.hstack([shortened()[i] for i in IDS]).tobytes()


def test_an_interrupt_while_waiting_for_the_first_sample() -> None:
    with Running(TOPOLOGY.name, "--set", f"external.listen=tcp/127.0.0.1:{free_port()}", "--no-record") as run:
        wait_for(lambda: any(e["event"] == "sensors" for e in run.said("gateway")))
        begin = time.monotonic()
        run.send("launcher", signal.SIGINT)
        assert run.end() == 130
        assert time.monotonic() - begin < 10
    assert "Traceback" not in run.stderr


def test_the_port_of_somebody_else_is_named() -> None:
    made, endpoint = design()
    import socket

    with socket.create_server(("127.0.0.1", int(endpoint.rsplit(":", 1)[1]))), pytest.raises(RunError) as failed:
        duio_mesh.run(made, "run", record=False)
    assert f"the gateway could not listen on {endpoint} for the sensors" in str(failed.value)


def test_what_has_no_outside_world(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([str(TOPOLOGY), "--in-process", "--out", "run"]) == 2
    assert "come from outside" in capsys.readouterr().err
    assert not Path("run").exists()
    with pytest.raises(ScenarioError, match="nothing to simulate"):
        duio_mesh.simulate(base())
    assert cli.main([str(TOPOLOGY), "--dry-run"]) == 0
    shown = capsys.readouterr().out
    assert re.search(r"^duio-gateway +duio_mesh\.gateway ", shown, re.MULTILINE)
    assert "--spec" not in shown, "a gateway has no spec of its own before the run"
    assert "listens on tcp/127.0.0.1:7447 for building/1/y, building/2/y, building/3/y, building/4/y" in shown
    assert cli.main([str(TOPOLOGY), "--check"]) == 0
    assert "spectral_radius" in capsys.readouterr().out
    assert list(Path().iterdir()) == []
