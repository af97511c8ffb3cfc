"""The form of a topology file: which keys there are and what type each has. Shapes and names are checked in build.py.

A mapping that may take several forms (noise, control, a signal) is one model with every key optional and ``forms``
saying which of them exclude each other, so that a mistake gives one message instead of one per form.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from duio_mesh.faults import MAX_DELAY
from duio_mesh.scenario.problems import listed
from duio_mesh.scenario.strict import Strict

RESERVED: dict[str, str] = {}
"""Top-level keys that no version accepts yet; to accept one, give it a field in Topology and delete it here."""

MAX_STATES = 2000
MAX_NODES = 1000
MAX_TRACE = 250_000_000  # numbers in the estimates of a run (nodes x steps x states): 2 GB

Vector: TypeAlias = list[float]
Matrix: TypeAlias = list[list[float]]
Positive: TypeAlias = Annotated[float, Field(gt=0)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0)]
Probability: TypeAlias = Annotated[float, Field(ge=0, le=1)]
Seconds: TypeAlias = Annotated[float, Field(ge=1e-9, le=1e9)]
Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=100)]


def _misfit(message: str, at: str | None = None) -> PydanticCustomError:
    """Keys of one mapping that do not fit together; ``at`` is the key where the user should look."""
    return PydanticCustomError("misfit", "{message}", {"message": message, "at": at})


def _alternatives(model: type[OneOf]) -> list[dict[str, list[str]]]:
    """The same rule for editors."""
    return [{"required": [name]} for name in getattr(model, "forms", ())]


class OneOf(Strict):
    """A mapping of which exactly one of ``forms`` must be given."""

    model_config = ConfigDict(json_schema_extra=lambda schema, model: schema.update(oneOf=_alternatives(model)))
    forms: ClassVar[tuple[str, ...]]

    @model_validator(mode="after")
    def _exactly_one(self) -> OneOf:
        given = [name for name in self.forms if getattr(self, name) is not None]
        if len(given) > 1:
            raise _misfit(f"give either {given[0]} or {given[1]}, not both", at=given[1])
        if not given:
            raise _misfit(f"should have one of the keys {listed(self.forms)}")
        return self


class Constant(Strict):
    """The same value all the time."""

    value: float


class Wave(OneOf):
    """amplitude * f(2 pi t / period + phase), or f(rate * t + phase)."""

    forms = ("period", "rate")
    amplitude: float = 1.0
    period: Annotated[float | None, Field(ge=1e-9, le=1e9, description="seconds")] = None
    rate: Annotated[float | None, Field(ge=1e-9, le=1e9, description="rad/s")] = None
    phase: Annotated[float, Field(description="rad")] = 0.0


class Step(Strict):
    """``before`` until ``time`` (seconds), ``after`` from then on."""

    time: float
    after: float
    before: float = 0.0


class Gaussian(OneOf):
    """A fresh draw from a normal distribution at every step."""

    forms = ("std", "variance")
    mean: float = 0.0
    std: NotNegative | None = None
    variance: NotNegative | None = None


class Term(OneOf):
    """One term of a signal."""

    forms = ("constant", "sine", "cosine", "step", "square", "normal")
    constant: Constant | None = None
    sine: Wave | None = None
    cosine: Wave | None = None
    step: Step | None = None
    square: Wave | None = None
    normal: Gaussian | None = None


Signal: TypeAlias = float | Term | list[float | Term]
"""A constant, a term, or a sum of these."""


class Normal(Strict):
    """Mean and standard deviation: a number for all states, or one number per state."""

    mean: float | Vector
    std: NotNegative | list[NotNegative]


class InitialState(Strict):
    """Drawn anew for every seed."""

    normal: Normal


Weight: TypeAlias = float | Vector | Matrix
"""A number (times the identity), a diagonal, or a whole matrix."""


class LqrWeights(Strict):
    """u = F (x - reference), F the LQR gain for Q and R."""

    Q: Weight
    R: Weight
    reference: Vector | None = None


class Control(OneOf):
    """What drives the inputs."""

    forms = ("lqr", "F", "signals")
    lqr: LqrWeights | None = None
    F: Matrix | None = None
    reference: Vector | None = None
    signals: dict[str, Signal] | list[Signal] | None = None

    @model_validator(mode="after")
    def _reference_belongs_to_F(self) -> Control:
        if self.reference is not None and self.F is None:
            raise _misfit("a reference belongs to F, or inside lqr", at="reference")
        return self


class Noise(OneOf):
    """Independent white noise on every measurement, or v(t) through a channel: y = C x + channel v."""

    forms = ("variance", "std", "channel")
    variance: NotNegative | None = None
    std: NotNegative | None = None
    channel: Matrix | None = None
    signals: Annotated[list[Signal] | None, Field(description="one per column of channel")] = None

    @model_validator(mode="after")
    def _signals_belong_to_channel(self) -> Noise:
        if (self.signals is None) != (self.channel is None):
            raise _misfit("channel and signals belong together: one signal per column of the channel")
        return self


class Plant(Strict):
    """x+ = A x + B u + E w (or dx/dt), and what drives it."""

    time: Literal["discrete", "continuous"]
    period: Annotated[Seconds | None, Field(description="seconds per step of a discrete plant")] = None
    A: Annotated[Matrix, Field(min_length=1, max_length=MAX_STATES)]
    B: Matrix | None = None
    inputs: Annotated[list[Name], Field(description="names of the columns of B, in order", default_factory=list)]
    E: Annotated[Matrix | None, Field(description="the input that no node is told")] = None
    x0: Vector | InitialState
    control: Control | None = None
    disturbance: Annotated[list[Signal] | None, Field(description="one per column of E")] = None
    noise: Annotated[Noise | float | None, Field(description="of every node that does not say otherwise")] = None


class Node(Strict):
    """One sensor."""

    C: Annotated[Matrix, Field(min_length=1, max_length=MAX_STATES)]
    knows: Annotated[list[str], Field(description="names of the inputs that this node is told", default_factory=list)]
    noise: Noise | float | None = None
    keys: Annotated[
        str | Annotated[list[Name], Field(min_length=1)] | None,
        Field(description="external: one key for [y; u], or one for each of its numbers; default: external.key"),
    ] = None


Encoding: TypeAlias = Literal[
    "json", "float64", "std_msgs/Float64", "std_msgs/Float64MultiArray", "sensor_msgs/Temperature"
]


class External(Strict):
    """Where the measurements come from when the plant is not simulated."""

    model: Annotated[str | None, Field(description="plant file, with plant: external")] = None
    key: Annotated[str | None, Field(description="Zenoh key of a node's [y; u]; {node} is its id")] = None
    encoding: Encoding = "json"
    listen: Annotated[str | None, Field(description="where publishers connect; default tcp/127.0.0.1:7447")] = None
    connect: Annotated[str | None, Field(description="a Zenoh router to go to, instead of listening")] = None
    exposed: Annotated[bool, Field(description="whoever reaches the port may publish measurements")] = False
    end: Annotated[str | None, Field(description="key on which a publisher says that it is over")] = None
    hold: Annotated[
        float | None,
        Field(gt=0, le=86_400, description="seconds after a step's first sample; then late sensors keep their values"),
    ] = None
    start_within: Annotated[
        float, Field(gt=0, le=86_400, description="seconds in which every sensor must have spoken")
    ] = 60.0

    @model_validator(mode="after")
    def _one_way(self) -> External:
        if self.listen is not None and self.connect is not None:
            raise _misfit("give either listen or connect, not both", at="connect")
        return self


Link: TypeAlias = Annotated[list[float], Field(min_length=2, max_length=3)]
"""[i, j] or [i, j, weight]."""


class Graph(OneOf):
    """Who tells whom."""

    forms = ("edges", "arcs")
    edges: Annotated[list[Link] | None, Field(description="undirected: [i, j] or [i, j, weight]")] = None
    arcs: Annotated[list[Link] | None, Field(description="directed: [source, target] or [source, target, weight]")] = (
        None
    )


class Convergence(Strict):
    """Every node's RMS error over the last fraction of the run is below ``rms_below``."""

    rms_below: Positive
    over_last: Annotated[float, Field(gt=0, le=1)] = 0.5


class Run(Strict):
    """How long, from which seed, and what counts as success."""

    steps: Annotated[int, Field(ge=1, le=100_000_000)]
    seed: Annotated[int, Field(ge=0)] = 0
    step: Annotated[Seconds | None, Field(description="seconds per exchange of a continuous plant")] = None
    convergence: Convergence
    deadline: Annotated[float, Field(gt=0, le=86_400, description="seconds to wait for any one message")] = 5.0
    window: Annotated[int, Field(ge=1, le=100_000, description="steps that the plant may be ahead")] = 256
    batch: Annotated[
        int, Field(ge=1, le=10_000, description="steps fused as one block (admm only); estimates come so much late")
    ] = 1
    on_node_loss: Annotated[
        Literal["stop", "degrade", "restart"], Field(description="when a node's process is lost: end, go on, replace")
    ] = "stop"
    rejoin: Annotated[
        Literal["warm", "cold"], Field(description="a replaced node starts from its neighbours' estimates, or afresh")
    ] = "warm"
    max_seconds: Annotated[
        float | None, Field(gt=0, le=31_536_000, description="a run that takes longer fails; default: no limit")
    ] = None
    inputs: Annotated[bool, Field(description="every node keeps a tape of its inputs, to be replayed alone")] = False


class GilbertElliott(Strict):
    """Losses in bursts: from step to step the edge turns bad and good again, and loses frames accordingly."""

    worsen: Annotated[float, Field(gt=0, le=1, description="probability of good -> bad from one step to the next")]
    mend: Annotated[float, Field(gt=0, le=1, description="probability of bad -> good; bad lasts 1 / mend steps")]
    good: Annotated[Probability, Field(description="loss while good")] = 0.0
    bad: Annotated[Probability, Field(description="loss while bad")] = 1.0


Late: TypeAlias = Annotated[int, Field(ge=0, le=MAX_DELAY)]
Range: TypeAlias = Annotated[list[Late], Field(min_length=2, max_length=2)]


class Delay(OneOf):
    """How late frames are: always the same, or drawn anew for every frame between two numbers."""

    forms = ("steps", "rounds")
    steps: Annotated[Late | Range | None, Field(description="whole steps")] = None
    rounds: Annotated[
        Late | Range | None, Field(description="exchanges; past a step's last one they go on in the next")
    ] = None


During: TypeAlias = Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=2, max_length=2)]
"""From this step up to, not including, that step."""
Pairs: TypeAlias = Annotated[list[Annotated[list[int], Field(min_length=2, max_length=2)]], Field(min_length=1)]


class Affected(Strict):
    """Which edges, and when."""

    edges: Annotated[Pairs | None, Field(description="[i, j]: both directions")] = None
    arcs: Annotated[Pairs | None, Field(description="[source, target]: one direction")] = None
    during: Annotated[During | None, Field(description="[first step, first step after]; default: always")] = None

    @model_validator(mode="after")
    def _fit(self) -> Affected:
        if self.edges is not None and self.arcs is not None:
            raise _misfit("give either edges or arcs, not both", at="arcs")
        if self.during is not None and self.during[0] >= self.during[1]:
            raise _misfit(f"should end after it begins, not {self.during}", at="during")
        return self


class LinkFault(Affected):
    """What happens to the frames on some edges; on all of them when none is named."""

    loss: Annotated[Probability, Field(description="independent for every frame")] = 0.0
    gilbert_elliott: GilbertElliott | None = None
    delay: Delay | None = None
    duplicate: Annotated[Probability, Field(description="a second copy follows")] = 0.0
    reorder: Annotated[Probability, Field(description="overtaken by the next frame: one round late")] = 0.0
    corrupt: Annotated[Probability, Field(description="one bit flipped; the frame check refuses it")] = 0.0

    @model_validator(mode="after")
    def _something(self) -> LinkFault:
        if not (self.loss or self.duplicate or self.reorder or self.corrupt or self.gilbert_elliott or self.delay):
            raise _misfit("says no fault: give loss, gilbert_elliott, delay, duplicate, reorder or corrupt")
        return self


class Cut(Affected):
    """Nothing passes on these edges for a while."""

    @model_validator(mode="after")
    def _complete(self) -> Cut:
        if self.edges is None and self.arcs is None:
            raise _misfit("should have one of the keys edges or arcs")
        if self.during is None:
            raise _misfit("should have the key during: [first step, first step after]")
        return self


class NodeFault(OneOf):
    """What happens to a process at the beginning of a step."""

    forms = ("kill", "pause", "restart")
    node: int
    kill: Annotated[int | None, Field(ge=0, description="the step")] = None
    pause: Annotated[int | None, Field(ge=0, description="the step")] = None
    restart: Annotated[int | None, Field(ge=0, description="the step")] = None
    seconds: Annotated[float | None, Field(gt=0, le=86_400, description="how long a pause lasts")] = None
    away: Annotated[
        int | None, Field(ge=1, le=1_000_000, description="steps until it is back after a restart; default 10")
    ] = None

    @model_validator(mode="after")
    def _seconds_belong_to_pause(self) -> NodeFault:
        if (self.seconds is None) != (self.pause is None):
            raise _misfit("pause and seconds belong together: {node, pause: step, seconds: how long}")
        if self.away is not None and self.restart is None:
            raise _misfit("belongs to restart: {node, restart: step, away: steps}", at="away")
        return self


class Faults(Strict):
    """Faults on purpose, the same in every run with the same seed."""

    seed: Annotated[int | None, Field(ge=0, lt=1 << 63, description="of the faults alone; default: run.seed")] = None
    links: Annotated[list[LinkFault], Field(default_factory=list)]
    cuts: Annotated[list[Cut], Field(default_factory=list)]
    nodes: Annotated[list[NodeFault], Field(default_factory=list)]


Mode: TypeAlias = Literal["open", "password", "mtls"]


class Security(Strict):
    """Who may speak to the processes of a run."""

    mode: Mode
    keep: Annotated[bool, Field(description="leave the credentials in the run folder")] = False
    exposed: Annotated[bool, Field(description="an open run may listen beyond this host")] = False

    @model_validator(mode="after")
    def _fit(self) -> Security:
        if self.exposed and self.mode != "open":
            raise _misfit(f"belongs to the mode open; {self.mode} may listen beyond this host anyway", at="exposed")
        if self.keep and self.mode == "open":
            raise _misfit("belongs to password and mtls; an open run has no credentials", at="keep")
        return self


LEAST_TICK, MOST_TICK = 0.001, 3600.0  # seconds

Pace: TypeAlias = Literal["lockstep", "realtime"]


class Timing(Strict):
    """When steps happen."""

    mode: Pace
    tick: Annotated[
        float | None,
        Field(ge=LEAST_TICK, le=MOST_TICK, description="wall seconds per step; default: the plant's own"),
    ] = None
    wait: Annotated[
        float | None,
        Field(gt=0, le=0.9, description="part of a tick in which a node waits for its neighbours; default 0.5"),
    ] = None

    @model_validator(mode="after")
    def _belongs_to_realtime(self) -> Timing:
        for name in ("tick", "wait"):
            if self.mode == "lockstep" and getattr(self, name) is not None:
                raise _misfit("belongs to realtime; in lockstep a step takes as long as it takes", at=name)
        return self


class Timed(Strict):
    """Everything by its mode alone, or a mapping."""

    timing: Annotated[Pace | Timing, Field(description="lockstep, or on the wall clock")] = "lockstep"


class Protected(Strict):
    """Everything by its mode alone, or a mapping."""

    security: Annotated[Mode | Security, Field(description="who may speak")] = "open"


class Host(Strict):
    """One machine, and who runs there."""

    address: Annotated[Name, Field(description="IP address or name under which the other hosts reach this one")]
    runs: Annotated[
        list[int | Literal["plant", "recorder"]], Field(min_length=1, description="nodes by number; plant; recorder")
    ]
    port: Annotated[int, Field(ge=1, le=65_535, description="the first; one per process, or the router's alone")] = 7447
    listen: Annotated[Name | None, Field(description="IP address to listen on; default: the address")] = None
    via: Annotated[
        Name | None, Field(description="routed: an earlier host, whose router this one's dials; default: the first")
    ] = None


class Placed(Strict):
    """For several hosts."""

    hosts: Annotated[dict[str, Host] | None, Field(description="for export: who runs where")] = None
    transport: Annotated[
        Literal["direct", "routed"], Field(description="routed: through one Zenoh router per host")
    ] = "direct"


class Heading(Strict):
    """What a topology is called."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    description: Annotated[str, Field(max_length=10_000)] = ""


class Topology(Heading, Protected, Timed, Placed):
    """A whole topology file. ``observer`` holds ``method`` and that method's own options."""

    plant: str | Plant
    observer: dict[str, Any]
    nodes: dict[int, Node]
    graph: Graph
    run: Run
    faults: Faults | None = None
    external: External | None = None
