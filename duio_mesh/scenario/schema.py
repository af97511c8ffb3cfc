"""The form of a topology file: which keys there are and what type each has. Shapes and names are checked in build.py.

A mapping that may take several forms (noise, control, a signal) is one model with every key optional and ``forms``
saying which of them exclude each other, so that a mistake gives one message instead of one per form.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from duio_mesh.scenario.problems import listed
from duio_mesh.scenario.strict import Strict

RESERVED = dict.fromkeys(("faults", "timing", "security", "hosts"), "is reserved for a later version of duio_mesh")
"""Top-level keys that no version accepts yet; to accept one, give it a field in Topology and delete it here."""

MAX_STATES = 2000
MAX_NODES = 1000
MAX_TRACE = 250_000_000  # numbers in the estimates of a run (nodes x steps x states): 2 GB

Vector: TypeAlias = list[float]
Matrix: TypeAlias = list[list[float]]
Positive: TypeAlias = Annotated[float, Field(gt=0)]
NotNegative: TypeAlias = Annotated[float, Field(ge=0)]
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
    window: Annotated[int, Field(ge=1, le=100_000, description="steps that the plant may be ahead")] = 64


class Heading(Strict):
    """What a topology is called."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=100)]
    description: Annotated[str, Field(max_length=10_000)] = ""


class Topology(Heading):
    """A whole topology file. ``observer`` holds ``method`` and that method's own options."""

    plant: str | Plant
    observer: dict[str, Any]
    nodes: dict[int, Node]
    graph: Graph
    run: Run
