"""What a run writes and reads: nothing twice, nothing lost in a race, and a damaged file says that it is one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgpack
import numpy as np
import pytest

from duio_mesh.deploy.logs import Logs
from duio_mesh.journal import Journal, map_rows
from duio_mesh.process import Stop
from duio_mesh.recorder import _fits
from duio_mesh.run_folder import RunFolder
from duio_mesh.spec import NodeSpec, RecorderSpec, Wire, read_spec
from duio_mesh.tape import Tape, read_tape
from tests.replay.test_tape import SPEC

EXT_RECORD = 2  # spec.py's msgpack code


class Stopped:
    """An outlet in whose ``send`` the process is asked to stop."""

    def send(self, k: int, r: int, rows: object) -> None:
        raise Stop


def test_a_process_that_is_stopped_while_it_sends_has_written_its_rows_once() -> None:
    journal = Journal("rows.f64", 1, Stopped())  # type: ignore[arg-type]
    for k in range(5):
        journal._due = float("inf")
        journal.add((np.array([float(k)]),))
    with pytest.raises(Stop):
        journal.flush()
    journal.__exit__(None, None, None)
    assert map_rows("rows.f64", 1).ravel().tolist() == [0, 1, 2, 3, 4]


def test_a_tape_that_is_stopped_while_it_writes_has_its_records_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tape = Tape(SPEC)
    tape._due = float("inf")
    tape.write(("once",))
    file = tape._file
    assert file is not None

    class Slow:
        """A file in whose ``flush`` the process is asked to stop."""

        write = file.write

        def flush(self) -> None:
            raise Stop

    monkeypatch.setattr(tape, "_file", Slow())
    with pytest.raises(Stop):
        tape.flush()
    monkeypatch.setattr(tape, "_file", file)
    tape.__exit__(None, None, None)
    assert Path(SPEC.inputs).read_bytes().count(b"once") == 1


def test_runs_of_the_same_second_get_folders_of_their_own() -> None:
    with ThreadPoolExecutor(8) as pool:
        made = list(pool.map(lambda _: RunFolder.create("same", None).root, range(8)))
    assert len(set(made)) == 8
    assert Path("runs/same/latest").resolve() in made


@pytest.mark.parametrize("depth", [20, 400, 3000])
def test_a_spec_of_nested_records_is_refused(depth: int) -> None:
    data = msgpack.packb(0)
    for _ in range(depth):
        data = msgpack.packb(msgpack.ExtType(EXT_RECORD, data))
    Path("deep.spec").write_bytes(data)
    with pytest.raises(ValueError, match=r"deep\.spec is not a spec file: its records are nested too deeply"):
        read_spec(Path("deep.spec"), NodeSpec)


@pytest.mark.parametrize("made", [7, float("inf")])
def test_a_tape_whose_head_is_of_other_types_is_refused(made: float) -> None:
    from duio_mesh import tape as tapes

    head = msgpack.packb((tapes._Kind.HEAD, tapes.MAGIC, tapes.VERSION, made, 0, 0, 1, 7))
    Path("odd.tape").write_bytes(tapes._CHUNK.pack(*tapes._chunk_of(head)) + head)
    with pytest.raises(ValueError, match="is not a tape"):
        list(read_tape(Path("odd.tape")))


def test_a_log_that_was_cut_short_with_its_host_is_read_as_far_as_it_goes() -> None:
    log = Path("node-1.jsonl")
    log.write_text(
        '{"time": 1, "event": "ready"}\nnot ours\n{"time": 2, "event": "warning", "text": "hot"}\n{"time": 3, "ev'
    )
    logs = Logs()
    logs.read("node-1", log)
    assert logs.processes["node-1"].said["event"] == "ready"
    assert logs.processes["node-1"].warnings == ["hot"]
    log.write_text('{"time": 1, "event": "ready"}\n{"time": 2}\n')
    with pytest.raises(ValueError, match=r"node-1\.jsonl:2 is not an event of a process"):
        logs.read("node-1", log)


def test_the_recorder_takes_whole_rows_of_steps_that_there_are() -> None:
    from duio_mesh.mesh import Frame

    wire = Wire("run", (), ())
    spec = RecorderSpec(
        name="r", n=2, sizes={1: 3}, arcs=(), step=1.0, steps=10, recording="", live=False, description="",
        truth="", estimates={1: ""}, unknown_inputs=0, flags=False, watch_step=4, outside=False, tick=0.0, wire=wire,
    )  # fmt: skip
    good = [(None, 8, 0, 4), (1, 9, 0, 3), (1, 4, 1, 3000), (1, 0, 2, 10)]
    bad = [(None, 9, 0, 4), (None, 0, 0, 3), (1, 1_000_000, 0, 3), (1, 0, 0, 4), (1, 2**32 - 1, 2, 1), (1, 4, 1, 4)]
    for taken, frames in ((True, good), (False, bad)):
        for node, k, r, size in frames:
            assert _fits(spec, node, Frame(k, r, np.zeros(size))) is taken, (node, k, r, size)
