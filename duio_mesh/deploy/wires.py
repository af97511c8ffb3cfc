"""The wires of a run over many hosts: the same links as on one, over known addresses or through routers."""

from __future__ import annotations

import secrets
from pathlib import Path

from duio_mesh import credentials
from duio_mesh.deploy.places import Place, Sites
from duio_mesh.errors import ScenarioError
from duio_mesh.spec import Guard, RouterSpec, Wire
from duio_mesh.synthesis.design import Design
from duio_mesh.wiring import Links, check_address, largest_frame, lease


class SiteWiring:
    """The wires of one deployment; takes the place of ``wiring.Wiring``, which is for processes of one host."""

    def __init__(self, design: Design, sites: Sites, *, keys: Path, secrets_at: str, start: float) -> None:
        """``keys``: where credentials are written; ``secrets_at``: where each process will find its own; ``start``:
        seconds in which all processes have to be there.

        Raises ScenarioError for an open run beyond this host that nobody asked for by name, and for passwords.
        """
        security = design.scenario.security
        if security.mode == "password":
            raise ScenarioError(["security: hosts need mtls: a password hides nothing on the way from host to host"])
        for place in (*sites.places.values(), *sites.routers.values()):
            for name in place.names:
                check_address(name, security)
        self._guarded = security.mode == "mtls"
        self._design, self._sites, self._links = design, sites, Links(design, record=sites.record)
        self._keys, self._secrets_at, self._start = keys, secrets_at, start
        self._run, self._limit, self._lease = secrets.token_hex(4), largest_frame(design), lease(design)

    def wires(self) -> dict[str, Wire]:
        """The wire of every process but the routers. Credentials are written, for the routers as well."""
        sites, dials = self._sites, self._links.dials
        if self._guarded:
            names = {who: place.names for who, place in (*sites.places.items(), *sites.routers.items())}
            credentials.issue(self._keys, "mtls", self._run, dict.fromkeys(names, ()), names)
        if sites.routers:
            return {who: self._behind_router(who) for who in dials}
        return {
            who: Wire(
                run=self._run,
                listen=(self._endpoint(sites.places[who].listen),),
                connect=tuple(self._endpoint(sites.places[other].dial) for other in dialled),
                guard=self._guard(who, dialled),
                start=self._start,
                lease=self._lease,
            )
            for who, dialled in dials.items()
        }

    def routers(self) -> dict[str, RouterSpec]:
        """The spec of every router."""
        return {who: self._router(who, place) for who, place in self._sites.routers.items()}

    def _behind_router(self, who: str) -> Wire:
        router = self._sites.behind[who]
        at = self._endpoint(self._sites.routers[router].dial)
        guard = self._guard(who, (router,), router)
        return Wire(self._run, (), (at,), guard, mode="client", start=self._start, lease=self._lease)

    def _router(self, who: str, place: Place) -> RouterSpec:
        sites = self._sites
        up = sites.via.get(who)
        connect = (self._endpoint(sites.routers[up].dial),) if up else ()
        pairs = tuple((source, target) for target, heard in self._links.hears.items() for source in heard)
        guard = None
        if self._guarded:
            guard = Guard(
                mode="mtls",
                who=who,
                folder=self._secrets_at,
                hears=(),
                tells=(),
                dials=(up,) if up else (),
                limit=self._limit,
                probed=True,
                behind=sites.reached(who),
                pairs=pairs,
            )
        listen = (self._endpoint(place.listen),)
        wire = Wire(self._run, listen, connect, guard, mode="router", start=self._start, lease=self._lease)
        return RouterSpec(who, tuple(self._links.dials), wire)

    def _guard(self, who: str, dials: tuple[str, ...], through: str = "") -> Guard | None:
        if not self._guarded:
            return None
        return Guard(
            mode="mtls",
            who=who,
            folder=self._secrets_at,
            hears=self._links.hears[who],
            tells=self._links.tells(who),
            dials=dials,
            limit=self._limit,
            through=through,
            probed=True,
        )

    def _endpoint(self, at: str) -> str:
        return f"{'tls' if self._guarded else 'tcp'}/{at}"
