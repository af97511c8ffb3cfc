"""What may stand under ``observer:`` for ``method: augmented``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from duio_mesh.scenario.schema import Matrix, OneOf
from duio_mesh.scenario.strict import Strict
from duio_mesh.synthesis.absence import Absence

Order: TypeAlias = Annotated[int, Field(ge=0, le=1000)]


class H2(Strict):
    """Structured H2 design of all gains together."""

    transient: Annotated[float, Field(ge=0)] = 100.0
    """Weight of transients against noise: an initial error is priced like this many times the mean noise variance."""
    extra_states: Order | list[Order] = 0
    """beta_i, the dimension of xi_i: one number for all nodes, or one per node in the order of their ids."""
    starts: Annotated[int, Field(ge=1, le=1000)] = 3
    seed: Annotated[int, Field(ge=0)] = 0
    """Draws the starts. It is not the run's seed: the same gains serve every run."""


class FixedNode(Strict):
    """What the designer of a channel's compensator wants to choose for another node (F also for the channel)."""

    node: int
    F: Matrix | None = None
    """n x p_i; by default a mild filter plus a random part, because F must be generic."""
    K: Matrix | None = None
    """n x n; by default random. The channel's own K is always designed."""


class Channel(Strict):
    """A compensator at one node of each strongly connected component; the other nodes' K_i are random."""

    channel: int | None = None
    """The node with the compensator; by default the best one of its component."""
    fixed: tuple[FixedNode, ...] = ()
    tries: Annotated[int, Field(ge=1, le=1000)] = 12
    seed: Annotated[int, Field(ge=0)] = 0


class BraschPearson(Channel):
    """The paper's construction: pole placement with a compensator of order N - 1."""

    radius: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """The poles are spread evenly on the circle of this radius; 0 puts all of them in zero (deadbeat)."""
    tolerance: Annotated[float, Field(gt=0)] = 0.2
    """How far the computed spectral radius may exceed ``radius``: rounding moves an M-fold pole by 1e-16^(1/M)."""
    peak: Annotated[float, Field(ge=1)] = 1e6
    """The largest acceptable ||Phi^t||_2."""


class GivenNode(Strict):
    """One node's matrices; N, M and L follow from (9)."""

    node: int
    F: Matrix
    K: Matrix
    Q: Matrix | None = None
    R: Matrix | None = None
    S: Matrix | None = None
    H: Matrix | None = None
    """n x p_i with H C D = D (13); by default D (C D)^+."""


class Method(OneOf):
    """A way to find gains, with its own settings."""

    forms = ("h2", "brasch_pearson", "lqg", "given")
    h2: H2 | None = None
    brasch_pearson: BraschPearson | None = None
    lqg: Channel | None = None
    given: tuple[GivenNode, ...] | None = None


_DEFAULTS: dict[str, H2 | BraschPearson | Channel] = {"h2": H2(), "brasch_pearson": BraschPearson(), "lqg": Channel()}


class Options(Absence):
    """The keys under ``observer:`` for ``method: augmented``."""

    gains: Literal["h2", "brasch_pearson", "lqg"] | Method = "h2"
    rate: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Every error must decay faster than rate^t."""
    delay: Literal[0, 1] = 0
    """1: each message takes a whole step; gains h2 or given only."""
    accept_unstable: bool = False
    """Run gains that miss ``rate`` all the same; the certificate says so. For gains: given."""

    @property
    def name(self) -> str:
        """Of the chosen method."""
        if isinstance(self.gains, str):
            return self.gains
        return next(form for form in self.gains.forms if getattr(self.gains, form) is not None)

    def chosen(self) -> H2 | BraschPearson | Channel | tuple[GivenNode, ...]:
        """The settings of the chosen method."""
        if isinstance(self.gains, str):
            return _DEFAULTS[self.gains]
        found: H2 | BraschPearson | Channel | tuple[GivenNode, ...] = getattr(self.gains, self.name)
        return found

    @property
    def written(self) -> bool:
        """Whether the file holds gains, which are in its units."""
        chosen = self.chosen()
        return isinstance(chosen, tuple) or (isinstance(chosen, Channel) and bool(chosen.fixed))
