"""The file survives a kill, a frozen viewer holds nobody up, and nothing is left behind or told to anybody."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from pathlib import Path

import psutil
import pytest
from synthetic import make_rows, make_spec, read_series

from duio_mesh.report import streams
from duio_mesh.report.recording import Recording

WRITER = """
import sys
from pathlib import Path
from synthetic import make_rows, make_spec
from duio_mesh.report.recording import Recording

spec = make_spec(Path(sys.argv[1]), nodes=2, n=3, steps=101, live=sys.argv[2] == "live")
truth, rows = make_rows(spec)
recording = Recording(spec)
for k in range(0, 80, 10):
    recording.truth(k, truth[k : k + 10])
    for i in rows:
        recording.estimates(i, k, rows[i][k : k + 10])
    recording.flush()
print(recording.url, flush=True)
sys.stdin.readline()
recording.close()
"""


def writer(path: Path, kind: str, home: Path) -> subprocess.Popen[str]:
    """A process that records 80 of 101 steps, says its address, and closes when it is told to."""
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path), kind],
        env={"HOME": str(home), "PATH": os.environ["PATH"], "PYTHONPATH": str(Path(__file__).parent)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_what_was_flushed_survives_a_kill(tmp_path: Path) -> None:
    path = tmp_path / "r.rrd"
    process = writer(path, "file", tmp_path)
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.communicate()
    truth, rows = make_rows(make_spec(path, nodes=2, n=3))
    for i in (1, 2):
        steps, values = read_series(path, f"/state/x3/node_{i}")
        assert steps.tolist() == list(range(80))
        assert values.tobytes() == rows[i][:80, 2].tobytes()
        assert read_series(path, f"/error/node_{i}")[0].tolist() == list(range(80))
    assert read_series(path, "/state/x1/actual")[1].tobytes() == truth[:80, 0].tobytes()


def test_nothing_is_printed_configured_told_or_left(tmp_path: Path) -> None:
    """Rerun's viewer keeps statistics and a configuration; recording must not, and listens on the loopback only."""
    home = tmp_path / "home"
    home.mkdir()
    process = writer(tmp_path / "r.rrd", "live", home)
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    sockets = psutil.Process(process.pid).net_connections("inet")
    assert [(s.status, s.laddr.ip, s.laddr.port) for s in sockets] == [("LISTEN", "127.0.0.1", _port(url))]
    assert psutil.Process(process.pid).children() == []
    said, complained = process.communicate("close\n", timeout=30)
    assert (said, complained, process.returncode) == ("", "", 0)
    assert list(home.iterdir()) == []
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", _port(url)))


def _port(url: str) -> int:
    assert url.startswith("rerun+http://127.0.0.1:")
    return int(url.removeprefix("rerun+http://127.0.0.1:").removesuffix("/proxy"))


def watch(url: str) -> socket.socket:
    """A viewer that asks for everything and reads only what the caller reads: HTTP/2 by hand, one gRPC request."""

    def frame(kind: int, flags: int, stream: int, payload: bytes = b"") -> bytes:
        return struct.pack(">I", len(payload))[1:] + bytes([kind, flags]) + struct.pack(">I", stream) + payload

    def field(name: str, value: str) -> bytes:
        return b"\0" + bytes([len(name)]) + name.encode() + bytes([len(value)]) + value.encode()

    wanted = {
        ":method": "POST",
        ":scheme": "http",
        ":path": "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages",
        ":authority": f"127.0.0.1:{_port(url)}",
        "content-type": "application/grpc",
        "te": "trailers",
    }
    headers = b"".join(field(name, value) for name, value in wanted.items())
    viewer = socket.create_connection(("127.0.0.1", _port(url)), timeout=10)
    start = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
    viewer.sendall(start + frame(4, 0, 0) + frame(1, 4, 1, headers) + frame(0, 1, 1, b"\0\0\0\0\0"))
    return viewer


def test_a_frozen_viewer_holds_nobody_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "QUEUE", 8)
    monkeypatch.setattr(streams, "HISTORY", "1MiB")
    K = 300_000
    spec = make_spec(tmp_path / "r.rrd", nodes=2, n=4, steps=K, live=True)
    truth, rows = make_rows(spec)
    recording = Recording(spec)
    assert recording.url is not None
    assert recording._live is not None
    with watch(recording.url) as viewer:
        received = b""
        for k in range(0, K, 1000):
            recording.truth(k, truth[k : k + 1000])
            for i in rows:
                recording.estimates(i, k, rows[i][k : k + 1000])
            recording.flush()
            if len(received) < 4096:  # then it freezes
                received += viewer.recv(4096)
        assert b"duio_mesh synthetic_ring" in received
        assert recording.dropped > 0
        recording.close()
    recording._live._thread.join(30)  # the viewer is gone: what was left behind ends
    assert not recording._live._thread.is_alive()
    for i in rows:
        assert read_series(tmp_path / "r.rrd", f"/error/node_{i}")[0].tolist() == list(range(K))


def test_a_full_queue_drops_and_the_end_does_not_wait_for_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same with a server that takes nothing at all."""
    monkeypatch.setattr(streams, "QUEUE", 3)
    monkeypatch.setattr(streams, "LINGER", 0.01)
    frozen, thaw = threading.Event(), threading.Event()
    send = streams.Opening.send

    def stuck(self: streams.Opening, stream: object, batch: streams.Batch) -> None:
        if threading.current_thread().name == "live":
            frozen.set()
            thaw.wait(20)
        send(self, stream, batch)

    monkeypatch.setattr(streams.Opening, "send", stuck)
    spec = make_spec(tmp_path / "r.rrd", nodes=1, n=2, steps=40, live=True)
    truth, rows = make_rows(spec)
    recording = Recording(spec)
    assert frozen.wait(10)
    before = recording.dropped
    for k in range(40):
        recording.truth(k, truth[k : k + 1])
        recording.estimates(1, k, rows[1][k : k + 1])
        recording.flush()
    assert recording.dropped - before >= 3 * 40 - 3  # truth x1, x2 and so on: three series and more
    recording.close()
    assert read_series(tmp_path / "r.rrd", "/state/x1/node_1")[1].tobytes() == rows[1][:, 0].tobytes()
    thaw.set()
    assert recording._live is not None
    recording._live._thread.join(20)
    assert not recording._live._thread.is_alive()


def test_a_port_that_somebody_took_is_not_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        ports = iter([taken.getsockname()[1], streams._free_port()])
        monkeypatch.setattr(streams, "_free_port", lambda: next(ports))
        with Recording(make_spec(tmp_path / "r.rrd", nodes=1, n=1, steps=1, live=True)) as recording:
            assert recording.url is not None
            assert _port(recording.url) != taken.getsockname()[1]
            with watch(recording.url) as viewer:
                assert viewer.recv(9)


FULL = """
import os, resource, sys
from pathlib import Path
from synthetic import make_rows, make_spec
from duio_mesh.report.recording import Recording

spec = make_spec(Path(sys.argv[1]), nodes=2, n=3, steps=20_000)
truth, rows = make_rows(spec)
recording = Recording(spec)
resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000))  # from here on a write beyond it fails
try:
    recording.fill(truth, rows)
    getattr(recording, sys.argv[2])()
except OSError as e:
    print(e, flush=True)
os._exit(0)  # as a recorder ends
"""


@pytest.mark.parametrize("call", ["flush", "close"])
def test_a_file_that_cannot_grow_is_said(tmp_path: Path, call: str) -> None:
    path = tmp_path / "r.rrd"
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(path), call],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert f"{path} is incomplete" in done.stdout
    assert path.stat().st_size <= 1_000_000
