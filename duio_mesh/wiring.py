"""Who listens where, who dials whom, and with which credentials: one Wire per process of a run.

The later of two neighbours dials the earlier one, every node dials the plant, and the recorder dials everybody, so that
nobody has to wait for it or misses it.
"""

from __future__ import annotations

import ipaddress
import secrets
import socket
from pathlib import Path

from duio_mesh import credentials
from duio_mesh.errors import ScenarioError
from duio_mesh.journal import BATCH_BYTES
from duio_mesh.scenario.model import Security
from duio_mesh.simulation import estimate_sizes
from duio_mesh.spec import LEASE, Guard, Wire
from duio_mesh.synthesis.design import Design

LOOPBACK = "127.0.0.1"
MARGIN = 4  # times the largest frame that can be foreseen: one refused for its size is lost without a word


def check_address(address: str, security: Security) -> None:
    """Raise ScenarioError when a run would listen where strangers can reach it, and nobody asked for that by name."""
    if security.mode == "open" and not security.exposed and not _is_loopback(address):
        raise ScenarioError(
            [
                f"security: listening on {address}, beyond this host, needs 'password' or 'mtls'; whoever reaches an "
                "open run can read and write its messages (to have it so anyway: security: {mode: open, exposed: true})"
            ]
        )


def _is_loopback(address: str) -> bool:
    try:
        return ipaddress.ip_address(address).is_loopback
    except ValueError:  # a name
        return address == "localhost"


class Links:
    """Who dials whom, and who has something to tell whom, by names of processes."""

    def __init__(self, design: Design, *, record: bool) -> None:
        names = {i: f"node-{i}" for i in sorted(design.nodes)}
        self.dials: dict[str, tuple[str, ...]] = {"plant": ()}
        self.hears: dict[str, tuple[str, ...]] = {"plant": tuple(names.values())}  # their credits
        for i, spec in design.nodes.items():
            near = {*spec.hears, *spec.tells}
            self.dials[names[i]] = ("plant", *(names[j] for j in sorted(near) if j < i))
            self.hears[names[i]] = ("plant", *(names[j] for j in sorted(spec.hears)))
        if record:
            self.dials["recorder"] = self.hears["recorder"] = ("plant", *names.values())

    def tells(self, who: str) -> tuple[str, ...]:
        """Those that ``who`` has something to tell."""
        return tuple(other for other, heard in self.hears.items() if who in heard)


class Wiring:
    """The wires of one run; holds the ports until ``release``."""

    def __init__(self, design: Design, keys: Path, *, record: bool, address: str = LOOPBACK) -> None:
        """``keys``: where credentials go when the run needs them. Raises ScenarioError: see ``check_address``."""
        self._security = design.scenario.security
        check_address(address, self._security)
        self._keys, self._address = keys, address
        self._run = secrets.token_hex(4)
        self._limit, self._lease = largest_frame(design), lease(design)
        self._held: list[socket.socket] = []
        self._links = Links(design, record=record)

    def wires(self) -> dict[str, Wire]:
        """The wire of every process; its port is reserved, its credentials are written."""
        link = "tls" if self._security.mode == "mtls" else "tcp"
        dials = self._links.dials
        at = {who: f"{link}/{self._address}:{self._reserve()}" for who in dials if who != "recorder"}
        folders: dict[str, Path] = {}
        if self._security.mode != "open":
            folders = credentials.issue(self._keys, self._security.mode, self._run, dials, self._address)
        return {
            who: Wire(
                run=self._run,
                listen=(at[who],) if who in at else (),
                connect=tuple(at[other] for other in dialled),
                guard=self._guard(who, folders[who]) if who in folders else None,
                lease=self._lease,
            )
            for who, dialled in dials.items()
        }

    def release(self) -> None:
        """Let go of the ports: their processes have them now."""
        for s in self._held:
            s.close()

    def _guard(self, who: str, folder: Path) -> Guard:
        return Guard(
            mode=self._security.mode,
            who=who,
            folder=str(folder),
            hears=self._links.hears[who],
            tells=self._links.tells(who),
            dials=self._links.dials[who],
            limit=self._limit,
        )

    def _reserve(self) -> int:
        """A free port, kept bound (not listening) until the process that gets it listens there."""
        s = socket.socket()
        self._held.append(s)
        s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        s.bind((self._address, 0))
        return int(s.getsockname()[1])


def lease(design: Design) -> float:
    """Seconds after which a silent peer counts as gone: a process may be stopped, or a link down, for a deadline."""
    return max(LEASE, design.plant.deadline)


def largest_frame(design: Design) -> int:
    """Bytes that no honest payload of this run reaches.

    The largest are a node's vector (n numbers for each step of a batch, or n (n + 1) / 2 when ADMM sets itself up), a
    block of samples, and a batch of rows.
    """
    n = design.scenario.plant.n
    vectors = max(n * n, max(n * spec.batch for spec in design.nodes.values()))
    samples = max(spec.block * (spec.p + spec.m) for spec in design.nodes.values())
    rows = max(BATCH_BYTES // 8, n, *estimate_sizes(design).values())
    return MARGIN * 8 * max(vectors, samples, rows)
