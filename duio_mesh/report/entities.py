"""What a recording holds and where: entity paths, colours, and how much of a long or wide run is kept."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from duio_mesh.spec import RecorderSpec

ERROR_ROWS = 2_000_000  # error norms in a recording, all nodes together (about 25 bytes each)
STATE_VALUES = 4_000_000  # values of states, estimates and reconstructions (about 25 bytes each)
SERIES = 640  # lines of states, estimates and reconstructions

EVENTS, DESCRIPTION, RATES, GAPS = "/events", "/description", "/rates", "/missing"
STATES = {"up": 0x3FB950FF, "unknown": 0x8B949EFF, "late": 0xD29922FF, "down": 0xF85149FF}
"""How a process or an edge can be, the better before the worse, and its colour (RGBA): green, grey, amber, red."""
FLAGS = {"trusted": 0x3FB950FF, "flagged": 0xD29922FF, "no estimate": 0x30363DFF}
"""How a node takes its own estimate where messages can be missing, and its colour: green, amber, nearly black."""
TRUTH = 0x9AA0A6FF

WATCHED = ("residual", "disagreement")
"""What is recorded of the rounds of a watched step."""

Column: TypeAlias = tuple[int, str]
"""(column of a row, entity path that it is recorded under)."""

# Okabe and Ito's eight (readable with any colour vision, on dark and on light) without black, and a brown
_FEW = (0x56B4E9, 0xE69F00, 0x009E73, 0xCC79A7, 0xF0E442, 0x0072B2, 0xD55E00, 0xB07D5B)


@dataclass(frozen=True)
class Entities:
    """The entities of one run's recording."""

    spec: RecorderSpec

    @cached_property
    def ids(self) -> tuple[int, ...]:
        """Node ids, ascending."""
        return tuple(sorted(self.spec.sizes))

    @cached_property
    def colours(self) -> dict[int, int]:
        """Every node's colour (RGBA), the same in all views and figures."""
        return dict(zip(self.ids, palette(len(self.ids)), strict=True))

    def name(self, i: int) -> str:
        """node_3, padded so that names sort like numbers."""
        return f"node_{i:0{len(str(max(self.ids)))}d}"

    def error(self, i: int) -> str:
        """log10 of the 2-norm of x-hat_i - x."""
        return f"/error/{self.name(i)}"

    def state(self, c: int) -> str:
        """The parent of everything that is known of state c (0-based; x1 is the first)."""
        return f"/state/x{c + 1:0{len(str(self.spec.n))}d}"

    def alive(self, who: str) -> str:
        """How a process is: ``who`` is its name, plant or node-3."""
        return f"/alive/{self._process(who)}"

    def flag(self, i: int) -> str:
        """Whether the node marks its estimate."""
        return f"/flag/{self.name(i)}"

    def gap(self, i: int) -> str:
        """How many neighbours the node went on without."""
        return f"{GAPS}/{self.name(i)}"

    def rate(self, who: str) -> str:
        """Steps per second of a process."""
        return f"{RATES}/{self._process(who)}"

    def _process(self, who: str) -> str:
        return self.name(int(who.removeprefix("node-"))) if who.startswith("node-") else who

    def point(self, i: int) -> str:
        """The node in the topology view."""
        return f"/mesh/nodes/{self.name(i)}"

    def ring(self, i: int) -> str:
        """The ring around the node in the topology view, in the colour of how it is."""
        return f"/mesh/alive/{self.name(i)}"

    def edge(self, i: int, j: int) -> str:
        """The edge in the topology view; both directions of an undirected edge are one."""
        return f"/mesh/edges/{min(i, j)}_{max(i, j)}"

    def rounds(self, kind: str, i: int) -> str:
        """log10 of the residual or the disagreement, round by round of the watched step."""
        return f"/rounds/{kind}/{self.name(i)}"

    @cached_property
    def edges(self) -> dict[tuple[int, int], bool]:
        """Every pair of nodes with an edge, smaller id first, and whether both tell each other."""
        arcs = set(self.spec.arcs)
        return {(min(a), max(a)): (a[1], a[0]) in arcs for a in sorted(arcs)}

    @cached_property
    def shown(self) -> tuple[int, ...]:
        """The states that are recorded: all, or evenly chosen ones where there would be too many lines."""
        extra = sum(size - self.spec.n - self.spec.flags for size in self.spec.sizes.values())
        room = max(1, (SERIES - extra) // (len(self.ids) + 1))
        return spread(range(self.spec.n), room)

    @cached_property
    def truth(self) -> tuple[Column, ...]:
        """Columns of a true state."""
        return tuple((c, f"{self.state(c)}/actual") for c in self.shown)  # sorts before node_: drawn below

    def estimates(self, i: int) -> tuple[Column, ...]:
        """Columns of node i's estimate row: states, then unknown inputs, then its own noise; not the flag."""
        n, q = self.spec.n, self.spec.unknown_inputs
        columns = [(c, f"{self.state(c)}/{self.name(i)}") for c in self.shown]
        for c in range(n, self.spec.sizes[i] - self.spec.flags):
            j = c - n
            path = f"/unknown_input/w{j + 1}/{self.name(i)}" if j < q else f"/noise/{self.name(i)}/v{j - q + 1}"
            columns.append((c, path))
        return tuple(columns)

    @cached_property
    def error_stride(self) -> int:
        """Steps of which only the least and the greatest error norm are kept; 1 keeps all."""
        rows = len(self.ids) * self.spec.steps
        return 1 if rows <= ERROR_ROWS else -(-2 * rows // ERROR_ROWS)

    @cached_property
    def error_rows(self) -> int:
        """Error norms of all nodes that are kept of a whole run."""
        return min(len(self.ids) * self.spec.steps, ERROR_ROWS)

    @cached_property
    def series(self) -> int:
        """Lines of states, estimates and reconstructions."""
        return len(self.truth) + sum(len(self.estimates(i)) for i in self.ids)

    @cached_property
    def state_stride(self) -> int:
        """Every how many steps a row of states, estimates and reconstructions is kept; 1 keeps all."""
        return max(1, -(-self.series * self.spec.steps // STATE_VALUES))

    @cached_property
    def state_values(self) -> int:
        """Values of states, estimates and reconstructions that are kept of a whole run."""
        return self.series * (self.spec.steps // self.state_stride)

    def kept(self) -> str:
        """In words (markdown), what of the run this recording holds."""
        errors, states = "every step", "every step"
        if self.error_stride > 1:
            errors = f"the least and the greatest of every {self.error_stride} steps"
        if self.state_stride > 1:
            states = f"every {self.state_stride}th step"
        some = ""
        if len(self.shown) < self.spec.n:
            some = f" of {len(self.shown)} of the {self.spec.n} states"
        return f"Error norms: {errors}. States and estimates{some}: {states}. The whole run is in trace.npz."


def spread(items: Sequence[int], room: int) -> tuple[int, ...]:
    """At most ``room`` of the items, evenly chosen, the first and the last among them."""
    if len(items) <= room:
        return tuple(items)
    return tuple(items[round(at)] for at in np.linspace(0, len(items) - 1, room))


def palette(count: int) -> list[int]:
    """So many colours (RGBA) that can be told apart as well as possible; never the grey of the truth."""
    if count <= len(_FEW):
        return [colour << 8 | 0xFF for colour in _FEW[:count]]
    colours = []
    for at in range(count):
        lightness, saturation = ((0.62, 0.75), (0.48, 0.65), (0.74, 0.60))[at % 3]
        parts = colorsys.hls_to_rgb(at / count, lightness, saturation)
        r, g, b = (round(255 * part) for part in parts)
        colours.append(r << 24 | g << 16 | b << 8 | 0xFF)
    return colours
