"""What a node process holds: its own, and nothing of anybody else's. Looked up in the memory of a real run."""

from __future__ import annotations

import re
import struct
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import psutil
import pytest

import duio_mesh
from duio_mesh.spec import NodeSpec, read_spec
from tests.conftest import TOPOLOGIES
from tests.processes.running import Running

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

# entries that exist nowhere else in the world: node i measures room 2 with this factor
MARKS = {1: 0.7310585786300049, 2: 0.8807970779778823, 3: 0.9525741268224334, 4: 0.9820137900379085}
TRUTH = 17.123456789012345  # first entry of the initial state


def marked() -> list[str]:
    """Overrides that put a mark into every node's C and into the truth."""
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml")
    options = []
    for i, node in scenario.nodes.items():
        C = node.C.copy()
        C[0, np.flatnonzero(C[0])[0]] = MARKS[i]
        options += ["--set", f"nodes.{i}.C={C.tolist()}"]
    x0 = [TRUTH] + [18.0] * 8
    return [*options, "--set", f"plant.x0={x0}"]


def memory(pid: int) -> bytes:
    """All readable private memory of a process."""
    parts = []
    maps = Path(f"/proc/{pid}/maps").read_text()
    with Path(f"/proc/{pid}/mem").open("rb", buffering=0) as mem:
        for first, last, rights in re.findall(r"^([0-9a-f]+)-([0-9a-f]+) (\S+)", maps, re.M):
            if rights.startswith("rw"):
                mem.seek(int(first, 16))
                try:
                    parts.append(mem.read(int(last, 16) - int(first, 16)))
                except OSError:
                    continue
    return b"".join(parts)


def test_a_node_holds_its_own_matrices_and_no_others() -> None:
    with Running("ring.yaml", *marked(), "--no-record") as run:
        run.until_row("node-3", 500)
        mine = memory(run.pid("node-3"))
        plants = memory(run.pid("plant"))
        for i, mark in MARKS.items():
            pattern = struct.pack("<d", mark)
            assert pattern in plants  # the plant measures for everybody, so the search does find what is there
            spec = (run.out / "nodes" / f"node-{i}.spec").read_bytes()
            for other, foreign in MARKS.items():
                if other != i:
                    assert struct.pack("<d", foreign) not in spec
            if i != 3:
                assert pattern not in mine, f"node 3 holds an entry of C_{i}"
        assert struct.pack("<d", TRUTH) not in mine
        laplacian = np.array([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 2, -1], [-1, 0, -1, 2]])
        assert laplacian.tobytes() not in mine
        for spec in (run.out / "nodes").glob("*.spec"):
            assert spec.stat().st_mode & 0o777 == 0o600


def test_a_node_process_has_no_foreign_library_mapped_and_is_small() -> None:
    with Running("ring.yaml") as run:
        run.until_row("node-3", 500)
        for i in (1, 2, 3, 4):
            pid = run.pid(f"node-{i}")
            mapped = Path(f"/proc/{pid}/maps").read_text().replace("libscipy_openblas", "")  # numpy's own
            for library in ("scipy", "cvxpy", "clarabel", "pydantic", "rerun", "pyarrow", "matplotlib"):
                assert library not in mapped, f"node {i} has {library} mapped"
            assert psutil.Process(pid).memory_full_info().pss < 20e6


def test_every_process_names_itself_and_listens_on_loopback_only() -> None:
    with Running("ring.yaml") as run:
        run.until_ready("recorder")
        run.until_row("node-1", 100)
        for who in ("plant", "node-1", "node-4", "recorder", "nursery"):
            process = psutil.Process(run.pid(who))
            assert process.cmdline()[0].startswith(f"duio-{who}")
            for c in process.net_connections():
                assert c.laddr.ip == "127.0.0.1"
                assert not c.raddr or c.raddr.ip == "127.0.0.1"


def test_links_exist_only_along_edges_and_to_plant_and_recorder() -> None:
    with Running("ring.yaml") as run:
        run.until_ready("recorder")
        run.until_row("node-1", 100)
        port = {f"node-{i}": read_port(run, f"node-{i}") for i in (1, 2, 3, 4)} | {"plant": read_port(run, "plant")}
        edges = {("node-1", "node-2"), ("node-2", "node-3"), ("node-3", "node-4"), ("node-1", "node-4")}
        allowed = edges | {(f"node-{i}", "plant") for i in (1, 2, 3, 4)}
        allowed |= {("recorder", who) for who in port}
        found = set()
        for who in (*port, "recorder"):
            for c in psutil.Process(run.pid(who)).net_connections():
                if c.status == psutil.CONN_ESTABLISHED and c.raddr.port in port.values():
                    other = next(w for w, p in port.items() if p == c.raddr.port)
                    found.add((who, other))
        assert {frozenset(pair) for pair in found} == {frozenset(pair) for pair in allowed}


def read_port(run: Running, who: str) -> int:
    kind = NodeSpec if who.startswith("node") else duio_mesh.spec.PlantSpec
    return int(read_spec(run.out / "nodes" / f"{who}.spec", kind).wire.listen[0].rsplit(":", 1)[1])


def test_a_spec_file_can_build_nothing_but_specs(tmp_path: Path) -> None:
    for value in ({"a": 1}, [1, 2], "text", msgpack.ExtType(7, b"x"), msgpack.ExtType(2, msgpack.packb(["eval", {}]))):
        path = tmp_path / "bad.spec"
        path.write_bytes(msgpack.packb(value))
        with pytest.raises(ValueError, match=r"bad\.spec"):
            read_spec(path, NodeSpec)


def test_a_node_started_by_hand_reads_its_spec_and_says_what_is_wrong(tmp_path: Path) -> None:
    import subprocess
    import sys

    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "ring.yaml"))
    path = tmp_path / "node-1.spec"
    duio_mesh.spec.write_spec(replace(design.nodes[1], wire=duio_mesh.spec.Wire("r", ("tcp/256.0.0.1:1",), ())), path)
    command = [sys.executable, "-m", "duio_mesh.node", "--spec", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert "node-1 could not open its links" in done.stdout
