"""The tape's form: what is given is on it, cut short anywhere it has its whole records, damaged it says so."""

from __future__ import annotations

import stat
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import duio_mesh
from duio_mesh import tape as tapes
from duio_mesh.arrays import Array
from duio_mesh.observers.absence import Late, flagged, take_late
from duio_mesh.observers.base import Estimate, reader
from duio_mesh.spec import NodeSpec
from duio_mesh.tape import Arrival, Call, Exchange, Head, Read, Record, Sample, Tape, ingredients, read_tape
from tests.conftest import TOPOLOGIES

PATH = Path("inputs/node-3.tape")
SPEC = NodeSpec(
    id=3,
    method="none",
    n=1,
    p=1,
    m=1,
    matrices={},
    options={},
    hears={},
    tells=(),
    steps=100,
    deadline=1.0,
    window=1,
    credit=1,
    block=1,
    batch=1,
    inputs=str(PATH),
)


class Diary:
    """An observer that only notes what it is given."""

    flagged = True

    def __init__(self) -> None:
        self.given: list[Any] = []
        self.rounds = 1

    def sample(self, y: Array, u: Array) -> None:
        self.given.append(("sample", y.tobytes(), u.tobytes()))

    def message(self, r: int) -> Array:
        return np.array([float(r)])

    def exchange(self, r: int, received: Mapping[int, Array]) -> None:
        self.given.append(("exchange", r, [(j, v.tobytes()) for j, v in received.items()]))

    def late(self, arrived: Sequence[Late]) -> None:
        self.given.append(("late", [(*late[:3], late.vector.tobytes()) for late in arrived]))

    def part_with(self, j: int) -> None:
        self.given.append(("part_with", j))

    def distrust(self) -> None:
        self.given.append(("distrust",))

    def resume(self, x: Array, y: Array, u: Array) -> None:
        self.given.append(("resume", x.tobytes(), y.tobytes(), u.tobytes()))

    def reset(self) -> None:
        raise AssertionError("a call that no tape knows")

    def estimate(self) -> Estimate:
        return Estimate(np.zeros(1))


def again(records: Sequence[Record]) -> list[Any]:
    """Give the records to another diary, by the tape's documentation."""
    diary = Diary()
    for record in records:
        match record:
            case Sample(y, u):
                diary.sample(y, u)
            case Exchange(r, received):
                diary.exchange(r, received)
            case Arrival(late):
                diary.late(late)
            case Call(name, arguments):
                getattr(diary, name)(*arguments)
    return diary.given


vectors = st.lists(st.floats(width=64), max_size=4).map(lambda v: np.array(v, dtype=np.float64))
small = st.integers(0, 2**32 - 1)
calls = st.one_of(
    st.tuples(st.just("sample"), vectors, vectors),
    st.tuples(st.just("exchange"), small, st.dictionaries(st.integers(1, 9), vectors, max_size=3)),
    st.tuples(st.just("late"), st.lists(st.builds(Late, st.integers(1, 9), small, small, vectors), min_size=1)),
    st.tuples(st.just("part_with"), st.integers(1, 9)),
    st.tuples(st.just("distrust")),
    st.tuples(st.just("resume"), vectors, vectors, vectors),
)


@given(st.lists(calls, max_size=20))
@settings(deadline=None, derandomize=True, max_examples=60)
def test_what_an_observer_is_given_is_what_is_read(said: list[Any]) -> None:
    PATH.unlink(missing_ok=True)
    diary = Diary()
    with Tape(SPEC) as tape:
        observer = tape.follow(diary)
        for name, *arguments in said:
            getattr(observer, name)(*arguments)
    if not said:
        assert PATH.read_bytes() == b""
        return
    head, *records = read_tape(PATH)
    assert head == Head(3, 0, 0, 100, ingredients(SPEC))
    assert again(records) == diary.given
    assert len(records) == len(diary.given) == len(said)


def test_everything_else_is_the_observers_own() -> None:
    diary = Diary()
    with Tape(SPEC) as tape:
        observer = tape.follow(diary)
        observer.estimate()  # before any sample nothing is read
        observer.sample(np.ones(2), np.zeros(0))
        assert observer.rounds == 1
        assert observer.message(7) == [7.0]
        assert flagged(observer)
        take_late(observer, [])  # nothing: not a call
        observer.estimate()  # somebody wants to know in the middle of the step: nothing new is read
        observer.exchange(0, {})
        assert reader(observer)()[0].state == [0.0]
        observer.estimate()  # of the same sample: not a second step
    assert [type(record) for record in read_tape(PATH)] == [Head, Sample, Exchange, Read]


def test_a_call_that_the_tape_does_not_know_is_refused_before_it_is_made() -> None:
    """Left out, it would make a tape that does not lead to the same bits."""
    with Tape(SPEC) as tape:
        observer: Any = tape.follow(Diary())
        with pytest.raises(TypeError, match=r"no record for the observer's call 'reset'"):
            observer.reset()


def written(steps: int, monkeypatch: pytest.MonkeyPatch, full: int = 200) -> bytes:
    """A tape of several chunks."""
    monkeypatch.setattr(tapes, "FULL", full)
    with Tape(SPEC) as tape:
        observer = tape.follow(Diary())
        for k in range(steps):
            observer.sample(np.array([k, 0.5]), np.array([1.0]))
            observer.exchange(0, {1: np.full(3, k), 2: np.zeros(3)})
            observer.estimate()
    return PATH.read_bytes()


def whole(data: bytes) -> int:
    """How many records the bytes hold, chunks aside, to any msgpack reader."""
    unpacker = msgpack.Unpacker(strict_map_key=False)
    unpacker.feed(data)
    return sum(fields[0] != 0 for fields in unpacker)


def test_cut_short_anywhere_it_has_its_whole_records(monkeypatch: pytest.MonkeyPatch) -> None:
    data = written(5, monkeypatch)
    everything = list(map(repr, read_tape(PATH)))
    assert len(everything) == whole(data) == 16
    for size in range(len(data)):
        PATH.write_bytes(data[:size])
        if whole(data[:size]):
            assert list(map(repr, read_tape(PATH))) == everything[: whole(data[:size])]
        else:
            with pytest.raises(ValueError, match="is empty"):
                list(read_tape(PATH))


def test_a_new_process_goes_on_where_the_old_one_was_cut_short(monkeypatch: pytest.MonkeyPatch) -> None:
    data = written(4, monkeypatch)
    everything = list(map(repr, read_tape(PATH)))
    second = Head(3, 1, 40, 60, ingredients(SPEC))
    for size in range(len(data) + 1):
        PATH.write_bytes(data[:size])
        with Tape(SPEC) as tape:
            tape.follow(Diary()).estimate()  # one that is given nothing leaves nothing
            tape.follow(Diary(), 40, 1).sample(np.ones(1), np.ones(1))
        found = list(map(repr, read_tape(PATH)))
        assert found[:-2] == everything[: whole(data[:size])]
        assert found[-2] == repr(second)


def test_a_flipped_bit_never_gives_another_record(monkeypatch: pytest.MonkeyPatch) -> None:
    data = written(3, monkeypatch)
    everything = list(map(repr, read_tape(PATH)))
    refused = 0
    for byte in range(len(data)):
        spoilt = bytearray(data)
        spoilt[byte] ^= 1 << byte % 8
        PATH.write_bytes(spoilt)
        found = []
        try:
            found.extend(map(repr, read_tape(PATH)))
        except ValueError:
            refused += 1
        assert found == everything[: len(found)]
    assert refused >= len(data) - 4  # a last chunk whose length has grown is taken for one that was cut short


def test_only_its_owner_can_read_it() -> None:
    with Tape(SPEC):
        assert stat.S_IMODE(PATH.stat().st_mode) == 0o600


def test_a_file_that_is_something_else_is_not_touched() -> None:
    PATH.parent.mkdir()
    PATH.write_bytes(b"precious and certainly not a tape")
    with pytest.raises(ValueError, match="is not a tape, or is damaged at byte 0"):
        Tape(SPEC)
    assert PATH.read_bytes() == b"precious and certainly not a tape"


def test_a_tape_of_another_format_says_so() -> None:
    with Tape(SPEC) as tape:
        tape.follow(Diary()).sample(np.ones(1), np.ones(1))
    data = PATH.read_bytes()
    record = msgpack.packb([1, tapes.MAGIC, tapes.VERSION + 1, 3, 0, 0, 100, {}])
    PATH.write_bytes(
        data[:3] + len(record).to_bytes(4, "big") + data[7:8] + zlib.crc32(record).to_bytes(4, "big") + record
    )
    with pytest.raises(ValueError, match=r"not a tape that this version reads"):
        list(read_tape(PATH))


def test_it_costs_nothing_when_it_is_not_asked_for() -> None:
    design = duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / "admm_ring.yaml"))
    diary = Diary()
    with Tape(design.nodes[1]) as tape:
        assert tape.follow(diary) is diary
    assert list(Path().iterdir()) == []
