"""What one process is given, and its file form.

Design is global, running is local: a ``NodeSpec`` holds one node's matrices, its neighbours' names and weights, and
where to listen. It holds no other node's C, no Laplacian and no truth. The file is msgpack with a closed set of types;
reading one can build nothing but the tuples below.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import msgpack
import numpy as np

from duio_mesh.arrays import Array, contiguous
from duio_mesh.faults import UNDISTURBED, Incoming, NodeFault, Rule, Span

START = 30.0  # seconds for all processes of a run to find each other
PATIENCE = 3  # deadlines: where a run goes on without lost nodes, the launcher settles first who is lost
LEASE = 10.0  # seconds of silence after which a link counts as lost; a process that dies is noticed at once

# the files in a process' folder of credentials
USERS, PASSWORD = "users", "password"
AUTHORITY, CERTIFICATE, KEY = "authority.pem", "certificate.pem", "key.pem"

Signals: TypeAlias = tuple[Any, ...]  # plain data: see duio_mesh.dynamics.signal


@dataclasses.dataclass(frozen=True)
class Guard:
    """Who may speak to this process and to whom it speaks, by names of processes; see duio_mesh.mesh.security."""

    mode: str  # password | mtls
    who: str  # this process
    folder: str  # its own credentials, and nobody else's
    hears: tuple[str, ...]  # processes that have something to tell it
    tells: tuple[str, ...]  # processes to which it has something to tell
    dials: tuple[str, ...]  # processes that it connects to; the others connect to it
    limit: int  # bytes of the largest payload that it accepts
    through: str = ""  # the router behind which all others are; "" where they are linked directly
    probed: bool = False  # a health probe, with this process' own credentials, may ask whether it is alive
    behind: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    """Of a router: direct neighbour -> the processes that are reached through it."""
    pairs: tuple[tuple[str, str], ...] = ()  # of a router: (source, target) of all that passes it


@dataclasses.dataclass(frozen=True)
class Wire:
    """Where a process listens and whom it dials; filled in by the launcher (or an operator) when a run starts."""

    run: str  # the run's name on the wire, unique per run
    listen: tuple[str, ...]  # Zenoh endpoints, e.g. tcp/127.0.0.1:7447
    connect: tuple[str, ...]
    guard: Guard | None = None  # None: whoever reaches a port may speak
    mode: str = "peer"  # peer | client (of a router) | router
    start: float = START  # seconds for all processes of a run to find each other
    lease: float = LEASE  # seconds of silence after which a link counts as lost


UNWIRED = Wire("", (), ())


@dataclasses.dataclass(frozen=True)
class NodeSpec:
    """One sensor process."""

    id: int
    method: str  # names duio_mesh.observers.<method>
    n: int  # states
    p: int  # measurements in y_i
    m: int  # known inputs in u_i
    matrices: Mapping[str, Array]  # the method's own, C-contiguous
    options: Mapping[str, Any]  # the method's own scalars
    hears: Mapping[int, float]  # in-neighbours and weights a_ij
    tells: tuple[int, ...]  # out-neighbours
    steps: int
    deadline: float  # seconds to wait for any one message
    window: int  # steps that the plant may be ahead of the slowest node
    credit: int  # report progress to the plant every this many steps
    block: int  # steps whose samples the plant sends in one frame
    batch: int  # steps between two exchanges: 1, or as many as the observer fuses at once
    tick: float = 0.0  # wall seconds per step; 0 is lockstep
    wait: float = 0.0  # seconds from a sample's arrival in which all rounds of its step may wait
    faults: Incoming = UNDISTURBED  # on purpose, of its own in-edges
    spoils: Mapping[int, tuple[Rule, ...]] = dataclasses.field(default_factory=dict)  # of frames to out-neighbours
    without: str = ""  # what to do without a neighbour's message; "" where none can be missing
    on_loss: str = "stop"  # when a neighbour is lost: stop | degrade | restart (it comes back)
    warm: bool = True  # start from the neighbours' estimates when this process replaces a lost one
    excuses: tuple[int, ...] = ()  # neighbours whose loss the certificate allows: the others' errors still go to zero
    settling: int = 0  # steps in which errors shrink to a thousandth, by the certificate
    acts: tuple[NodeFault, ...] = ()  # on purpose, to this very process
    breaks: tuple[int, ...] = ()  # steps at which a block of samples ends early, because somebody comes back then
    incarnation: int = 0  # how many processes of this node were there before this one
    outside: bool = False  # samples come from outside: they may take their time, and end before the last step
    kept: bool = False  # no estimate may be lost on its way to the recorder, which writes them down
    output: str = ""  # file of this node's own estimates, float64 rows; "" keeps none
    inputs: str = ""  # file of everything that the observer is given (duio_mesh.tape); "" keeps none
    wire: Wire = UNWIRED


@dataclasses.dataclass(frozen=True)
class SensorSpec:
    """What the plant needs to measure for one node: y_i = C_i x + F_i v_i, u_i = u[known]."""

    id: int
    C: Array  # (p, n)
    known: tuple[int, ...]  # columns of B
    channel: Array  # F_i (p, r)
    noise: Signals  # r signals


@dataclasses.dataclass(frozen=True)
class Outside:
    """Where the samples come from when no plant is simulated: publishers on a Zenoh network; see duio_mesh.gateway."""

    listen: str  # Zenoh endpoint where publishers connect; "" when the gateway connects to a router
    connect: str
    encoding: str  # one of duio_mesh.sensors.messages.ENCODINGS
    feeds: Mapping[int, tuple[str, ...]]  # node -> keys whose numbers, one after the other, are [y_i; u_i]
    sizes: Mapping[str, int]  # key -> numbers in each of its messages
    strays: str  # key expression of the same form as the keys; what else comes on it is refused and counted. "": none
    end: str  # key on which a publisher says that it is over; "": nobody does
    hold: float  # seconds after a step's first sample in which the others may come; infinite: up to the deadline
    start_within: float  # seconds in which every sensor must have spoken

    def widths(self) -> dict[int, int]:
        """Numbers in [y_i; u_i], by ascending node: a row of a gateway's journal holds them one after the other."""
        return {i: sum(self.sizes[key] for key in self.feeds[i]) for i in sorted(self.feeds)}


@dataclasses.dataclass(frozen=True)
class PlantSpec:
    """The plant process: an exact recursion, its drives, and its sensors."""

    time: str  # discrete | continuous
    step: float  # seconds between samples
    matrices: Mapping[str, Array]  # A, B, E; continuous plants add their exact propagators
    x0: Mapping[str, Array]  # {"value": (n,)} or {"mean": (n,), "std": (n,)}
    feedback: Mapping[str, Array]  # {"F": (m, n), "reference": (n,)}; {} when the control is open loop
    control: Signals  # m signals when open loop, else ()
    disturbance: Signals  # q signals
    sensors: tuple[SensorSpec, ...]
    seed: int
    steps: int
    window: int  # steps it may be ahead of the slowest node
    block: int  # steps whose samples travel in one frame
    deadline: float
    on_loss: str = "stop"  # when a node is lost
    absent: Mapping[int, tuple[Span, ...]] = dataclasses.field(default_factory=dict)  # node: steps without it, planned
    tick: float = 0.0  # wall seconds per step; 0: as fast as the slowest node
    wait: float = 0.0  # least seconds between two samples when it is behind the wall clock
    recorded: bool = False  # there is a recorder to wait for, a little
    kept: bool = False  # it must be there, and no row may be lost on its way to it
    output: str = ""  # file of the true state (of a gateway: of all samples), float64 rows
    outside: Outside | None = None  # a gateway takes the plant's place
    wire: Wire = UNWIRED


@dataclasses.dataclass(frozen=True)
class RecorderSpec:
    """The recorder process: whom it listens to and what it writes."""

    name: str
    n: int
    sizes: Mapping[int, int]  # node id -> floats per estimate row (n, plus what a method reconstructs, plus the flag)
    arcs: tuple[tuple[int, int], ...]
    step: float  # seconds between samples
    steps: int
    recording: str  # path of recording.rrd
    live: bool
    description: str  # markdown for the recording's first tab
    truth: str  # the plant's output file and ...
    estimates: Mapping[int, str]  # ... the nodes': rows that never arrived are read from here at the end
    unknown_inputs: int = 0  # of a row's columns after the n states, so many estimate w; the rest the node's own noise
    flags: bool = False  # the last column of a row says whether the node marks its estimate
    watch_step: int | None = None  # a step whose rounds the nodes tell one by one
    outside: bool = False  # nobody knows the true state: the errors are distances from the mean estimate
    tick: float = 0.0  # wall seconds per step, and nodes tell which neighbours were missing; 0 is lockstep
    kept: bool = False  # write all rows down as they come: their own journals are on other hosts
    wire: Wire = UNWIRED


@dataclasses.dataclass(frozen=True)
class RouterSpec:
    """The router process of one host: it carries what processes of hosts that cannot reach each other say."""

    who: str  # router-<host>
    carries: tuple[str, ...]  # all processes of the run; once they have come and gone, so does the router
    wire: Wire = UNWIRED


AnySpec: TypeAlias = NodeSpec | PlantSpec | RecorderSpec | RouterSpec
Spec = TypeVar("Spec", NodeSpec, PlantSpec, RecorderSpec, RouterSpec)

_TYPES: dict[str, type[Any]] = {
    t.__name__: t
    for t in (
        *(Guard, Wire, Rule, NodeFault, Incoming, NodeSpec),
        *(SensorSpec, Outside, PlantSpec, RecorderSpec, RouterSpec),
    )
}
_ARRAY, _RECORD = 1, 2  # msgpack extension codes
DEPTH = 8  # records within records, at most; a spec has four


def _pack(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        a = contiguous(value).astype("<f8", copy=False)
        return msgpack.ExtType(_ARRAY, msgpack.packb([list(a.shape), a.tobytes()]))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return msgpack.ExtType(_RECORD, msgpack.packb([type(value).__name__, fields], default=_pack))
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a spec cannot hold a {type(value).__name__}")


def _unpack(code: int, data: bytes, depth: int) -> Any:
    if depth > DEPTH:
        raise ValueError("its records are nested too deeply")
    if code == _ARRAY:
        shape, raw = msgpack.unpackb(data)
        return contiguous(np.frombuffer(raw, dtype="<f8").reshape(shape))
    if code == _RECORD:
        name, fields = _load(data, depth)
        return _TYPES[name](**fields)
    raise ValueError(f"unknown extension {code} in a spec")


def _load(data: bytes, depth: int = 0) -> Any:
    hook = partial(_unpack, depth=depth + 1)
    return msgpack.unpackb(data, ext_hook=hook, use_list=False, strict_map_key=False)


def blocks(first: int, steps: int, block: int, breaks: Iterable[int] = ()) -> Iterator[range]:
    """The steps from ``first`` up to ``steps``, cut at every multiple of ``block`` and at the steps ``breaks``."""
    ends = sorted(breaks)
    while first < steps:
        ends = [k for k in ends if k > first]
        end = min(first - first % block + block, steps, *ends[:1])
        yield range(first, end)
        first = end


def packed(value: Any) -> bytes:
    """Any part of a spec as msgpack. Raises TypeError for what a spec cannot hold."""
    data: bytes = msgpack.packb(value, default=_pack)
    return data


def write_spec(spec: AnySpec, path: Path) -> None:
    """Write ``spec`` readable by its owner only (mode 0600)."""
    data = packed(spec)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as f:
        f.write(data)


def read_spec(path: Path, kind: type[Spec]) -> Spec:
    """Read a spec of this kind.

    Raises ValueError when the file holds something else, OSError when it cannot be read.
    """
    try:
        spec = _load(path.read_bytes())
    except (ValueError, KeyError, TypeError, msgpack.UnpackException) as e:
        raise ValueError(f"{path} is not a spec file: {e}") from None
    if not isinstance(spec, kind):
        raise ValueError(f"{path} holds a {type(spec).__name__}, not a {kind.__name__}")
    return spec
