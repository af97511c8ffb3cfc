"""`launch.py replay` on the folders of real runs: the same bits, and a difference where there is one."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from signal import SIGKILL
from typing import Any

import numpy as np
import pytest

import duio_mesh
from duio_mesh import cli
from duio_mesh.arrays import contiguous
from duio_mesh.observers import make_observer
from duio_mesh.replay import command
from duio_mesh.replay.player import play
from duio_mesh.spec import NodeSpec, read_spec, write_spec
from duio_mesh.tape import Tape, read_tape
from tests.conftest import ROOT, TOPOLOGIES
from tests.processes.running import Running

pytestmark = [pytest.mark.mesh, pytest.mark.usefixtures("nothing_left")]

LOSSES = {"links": [{"loss": 0.2, "delay": {"steps": [0, 2]}, "reorder": 0.1}]}


def run(name: str, steps: int, **changes: Any) -> tuple[Any, duio_mesh.RunResult]:
    """(design, result) of a real run in ./run whose nodes keep their inputs."""
    changes = {"run.steps": steps, "run.inputs": True} | changes
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{name}.yaml", **changes))
    return design, duio_mesh.run(design, "run", record=False)


def replay(*options: str, node: int = 3, folder: str = "run") -> int:
    return cli.main(["replay", folder, "--node", str(node), *options])


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("partitioned", {}),
        ("augmented_example9", {}),
        ("admm_ring", {"run.batch": 8}),  # 200 rounds a block, and a set-up
        ("geometric_ring", {}),
        ("reduced_order_kundur8", {}),  # reconstructs w and v
        ("ring", {"faults": LOSSES}),
        ("finite_time_ring", {"faults": LOSSES, "observer.setup": "global", "run.batch": 3}),
        ("star", {"timing": {"mode": "realtime", "tick": 0.01}}),  # who is late is decided by the clock, once
    ],
    ids=lambda value: value if isinstance(value, str) else "-".join(value),
)
def test_every_node_of_every_method_to_the_same_bits(
    name: str, changes: dict[str, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    design, result = run(name, 40, **changes)
    capsys.readouterr()
    monkeypatch.setattr(command, "PATIENCE", 0.0)  # the progress bar, too
    for i in design.nodes:
        at = list(result.trace.node_ids).index(i)
        there = np.flatnonzero(~np.isnan(result.trace.xhat[at]).any(axis=1))
        assert len(there) == 40 or "nodes" in changes.get("faults", {})
        assert replay("--out", f"{i}.npz", node=i) == 0
        equal = f"node {i} ({design.scenario.method}): {len(there)} steps are equal to trace.npz"
        assert equal in capsys.readouterr().out
        with np.load(f"{i}.npz", allow_pickle=False) as rows:  # the comparison itself, made again by other means
            assert list(rows["step"]) == list(there)
            assert rows["xhat"].tobytes() == result.trace.xhat[at, there].tobytes()
            if i in result.trace.vhat:
                assert rows["vhat"].tobytes() == result.trace.vhat[i][there].tobytes()
            assert rows["flagged"].sum() == result.metrics["nodes"][str(i)].get("flagged", 0)


def test_a_node_that_was_killed_is_replayed_as_far_as_it_went(capsys: pytest.CaptureFixture[str]) -> None:
    with Running("ring.yaml", "--inputs", "--no-record") as killed:
        killed.until_row("node-3", 300)
        killed.send("node-3", SIGKILL)
        assert killed.end() == 3
    with np.load("run/trace.npz", allow_pickle=False) as trace:
        kept = int((~np.isnan(trace["xhat"][2]).any(axis=1)).sum())
    assert kept >= 300
    assert replay("--out", "rows.npz") == 0
    with np.load("rows.npz", allow_pickle=False) as rows:
        steps = len(rows["step"])
    assert steps > 30  # all but the last hundredth of a second
    assert f"node 3 (lmi): {min(kept, steps)} steps are equal to trace.npz" in capsys.readouterr().out
    Path("run/rows").mkdir()
    with np.load("run/trace.npz", allow_pickle=False) as trace:
        Path("run/rows/node-3.f64").write_bytes(trace["xhat"][2][:250].tobytes())
    Path("run/trace.npz").unlink()  # as when the launcher itself is killed
    assert replay() == 0
    assert "250 steps are equal to rows/node-3.f64" in capsys.readouterr().out


def test_what_is_wrong_with_a_folder_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    """One run, looked at, cut, damaged and changed."""
    _, result = run("ring", 60)
    tape, spec = Path("run/inputs/node-3.tape"), Path("run/nodes/node-3.spec")
    data, true = tape.read_bytes(), read_spec(spec, NodeSpec)
    assert tape.stat().st_mode & 0o777 == 0o600
    assert not Path("run/rows").exists()
    capsys.readouterr()

    def said(code: int, *options: str, node: int = 3) -> str:
        assert replay(*options, node=node) == code
        out, err = capsys.readouterr()
        assert bool(err) == (code == 2)
        assert "Traceback" not in out + err
        return out + err

    shown = said(0, "--step", "37")  # the numbers of that step, and what the trace has
    for number in (*result.trace.xhat[1][37], *result.trace.xhat[2][36], *result.trace.x[37]):
        assert f"{number:.10g}" in shown
    assert "38 steps are equal" in shown
    assert "from 2" in shown
    assert "from 4" in shown
    assert "round 0\n" in said(0, "--step", "37", "--round", "0")
    assert "there is no round 1 in step 37; its rounds are 0 only" in said(2, "--step", "37", "--round", "1")
    assert "11 steps are equal" in said(0, "--from", "10", "--until", "20", "--out", "some.npz")
    with np.load("some.npz", allow_pickle=False) as rows:
        assert list(rows["step"]) == list(range(10, 21))
        assert rows["xhat"].tobytes() == result.trace.xhat[2][10:21].tobytes()
    assert "already exists" in said(2, "--out", "some.npz")
    assert "step 60 is not on the tape of node 3: its last is step 59" in said(2, "--step", "60")

    assert "has no node 7; its nodes are 1, 2, 3, 4" in said(2, node=7)
    tape.write_bytes(data[: len(data) // 2])
    assert "trace.npz goes on to step 59" in said(0)
    tape.write_bytes(data[: len(data) // 2] + b"\0" + data[len(data) // 2 + 1 :])
    assert "inputs/node-3.tape is damaged" in said(2)
    tape.write_bytes(Path("run/inputs/node-2.tape").read_bytes())
    assert "the tape is of node 2, the spec of node 3" in said(2)
    tape.write_bytes(b"")
    assert "is empty" in said(2)
    tape.unlink()
    assert "run again with --set run.inputs=true" in said(2)
    tape.write_bytes(data)

    name = sorted(true.matrices)[0]
    changed = contiguous(true.matrices[name])
    changed.flat[np.flatnonzero(changed)[0]] *= 1 + 1e-12
    write_spec(replace(true, matrices={**true.matrices, name: changed}), spec)
    different = said(1)
    assert "steps differ from trace.npz, the first is step" in different
    assert "not as in the run: the matrices or options in the spec" in different
    write_spec(replace(true, p=true.p + 1), spec)
    assert "the spec of node 3 makes no observer" in said(2)
    spec.write_bytes(b"nothing of the kind")
    assert "node-3.spec is not a spec file" in said(2)
    write_spec(true, spec)
    assert "60 steps are equal" in said(0)
    trace = Path("run/trace.npz").read_bytes()
    Path("run/trace.npz").write_bytes(trace[: len(trace) // 2])
    assert "trace.npz is not a trace" in said(2)
    Path("run/trace.npz").unlink()
    assert "nothing to compare them with" in said(2)
    assert replay(folder="nowhere") == 2
    assert "nowhere is not the folder of a run" in capsys.readouterr().err


def test_without_being_asked_a_run_keeps_no_inputs(capsys: pytest.CaptureFixture[str]) -> None:
    run("partitioned", 5, **{"run.inputs": False})
    assert not Path("run/inputs").exists()
    assert replay() == 2
    design = duio_mesh.synthesise(
        duio_mesh.load_scenario(TOPOLOGIES / "partitioned.yaml", **{"run.steps": 5, "run.inputs": True})
    )
    from duio_mesh.launcher import run_in_process

    assert any("keeps no tapes" in warning for warning in run_in_process(design, "alone", record=False).warnings)


def test_a_process_that_joins_later_begins_anew() -> None:
    """Two processes on one tape, the second with a last batch that is shorter."""
    scenario = duio_mesh.load_scenario(TOPOLOGIES / "finite_time_ring.yaml", **{"run.steps": 23, "run.batch": 4})
    spec = replace(duio_mesh.synthesise(scenario).nodes[1], inputs="node-1.tape")
    random, ran = np.random.default_rng(5), []
    for incarnation, (first, stop) in enumerate([(0, 8), (12, 23)]):
        with Tape(spec) as tape:
            observer: Any = tape.follow(make_observer(replace(spec, steps=23 - first)), first, incarnation)
            for k in range(first, stop, 4):
                for _ in range(k, min(k + 4, stop)):
                    observer.sample(random.normal(size=spec.p), random.normal(size=spec.m))
                for r in range(observer.rounds):
                    size = observer.message(r).size
                    observer.exchange(r, {j: random.normal(size=size) for j in sorted(spec.hears)})
                ran += [e.state.tobytes() for e in observer.batch()]
    blocks = list(play(spec, read_tape(Path("node-1.tape"))))
    assert [k for block in blocks for k in block.steps] == [*range(8), *range(12, 23)]
    assert [e.state.tobytes() for block in blocks for e in block.estimates] == ran
    assert [block.head.incarnation for block in blocks] == [0, 0, 1, 1, 1]
    with pytest.raises(ValueError, match=r"does not fit the spec: the spec does not hear node\(s\) \[2, 3\]"):
        list(play(replace(spec, hears={}), read_tape(Path("node-1.tape"))))
    with pytest.raises(ValueError, match="does not fit the spec: step 0 has"):
        list(play(replace(spec, p=spec.p + 1), read_tape(Path("node-1.tape"))))


def test_the_input_that_made_an_observer_fail_is_there() -> None:
    spec = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "finite_time_ring.yaml")).nodes[1]
    assert spec.options["setup"] == "distributed"
    spec = replace(spec, inputs="node-1.tape")
    with Tape(spec) as tape:
        observer = tape.follow(make_observer(spec))
        observer.sample(np.ones(spec.p), np.ones(spec.m))
        with pytest.raises(duio_mesh.RunError, match="no message"):
            observer.exchange(0, {})
    (block,) = play(spec, read_tape(Path("node-1.tape")), watch=0)
    assert isinstance(block.failure, duio_mesh.RunError)
    assert not block.went_on
    assert (list(block.steps), block.exchanged, block.rounds[0].received) == ([0], 1, {})


def test_the_debugger_stops_right_before_the_step_and_nothing_is_started() -> None:
    """The real command, with somebody typing."""
    _, result = run("partitioned", 8)
    code = "import sys; from duio_mesh.cli import main; c = main(sys.argv[1:]); sys.exit(c or 'zenoh' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, "replay", "run", "--node", "3", "--step", "5", "--pdb"],
        input="p block.first, observer.estimate().state[0].item()\nc\n",
        capture_output=True,
        text=True,
        check=False,
        cwd=Path.cwd(),
        env={"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stderr
    assert f"(5, {result.trace.xhat[2][4][0].item()!r})" in done.stdout
    assert "6 steps are equal" in done.stdout
