"""One compose file per host: every process a container that sees its own secrets and its own folder of rows."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from duio_mesh.deploy.bundle import (
    ENVIRONMENT,
    PROBE_EVERY,
    PROBE_RETRIES,
    PROBE_TIMEOUT,
    ROWS,
    SECRETS,
    Parcel,
    pack,
)
from duio_mesh.deploy.documents import write_documents
from duio_mesh.deploy.places import object_name, on_hosts
from duio_mesh.synthesis.design import Design

USER = "1000:1000"  # of the image
HEAD = """\
The processes of {name} on host {host}, written by `launch.py export --compose`.
Copy this folder to that host and run `docker compose up` in it. secrets/ and rows/ must belong to user {user}.
In rows/ every process leaves what it wrote: collect rows/ of all hosts for `launch.py gather`."""


def export(design: Design, out: Path, image: str, start: float) -> list[Path]:
    """Write OUT/<host>/: compose.yaml, secrets/<process>/ and rows/<process>/; the compose files.

    Raises ScenarioError when the topology names no hosts, and see ``bundle.pack``.
    """
    scenario = design.scenario
    sites = on_hosts(scenario)
    out.mkdir(parents=True, exist_ok=True)
    parcels = pack(design, sites, out / "secrets", start)
    written = []
    for host in scenario.hosts.by_name:
        here = [parcel for parcel in parcels if parcel.place.host == host]
        folder = out / host
        for kind, mode in (("secrets", 0o700), ("rows", 0o755)):
            (folder / kind).mkdir(mode=mode, parents=True)
        for parcel in here:
            (out / "secrets" / parcel.who).rename(folder / "secrets" / parcel.who)
            (folder / "rows" / parcel.who).mkdir()
        written.append(folder / "compose.yaml")
        head = HEAD.format(name=scenario.name, host=host, user=USER)
        write_documents(written[-1], head, [project(object_name(scenario, host), here, image, start)])
    (out / "secrets").rmdir()
    return written


def project(name: str, parcels: Iterable[Parcel], image: str, start: float) -> dict[str, Any]:
    """The compose file of one host."""
    parcels = list(parcels)
    secrets = {
        f"{parcel.who}.{file.removeprefix(f'{parcel.who}.')}": {"file": f"./secrets/{parcel.who}/{file}"}
        for parcel in parcels
        for file in parcel.files
    }
    return {"name": name, "services": {p.who: _service(p, image, start) for p in parcels}, "secrets": secrets}


def _service(parcel: Parcel, image: str, start: float) -> dict[str, Any]:
    who = parcel.who
    return {
        "image": image,
        "entrypoint": parcel.command,
        "network_mode": "host",  # its addresses are those of the topology
        "user": USER,
        "read_only": True,
        "tmpfs": ["/tmp"],  # noqa: S108  (in the container)
        "cap_drop": ["ALL"],
        "security_opt": ["no-new-privileges:true"],
        "environment": ENVIRONMENT,
        "secrets": [
            {"source": f"{who}.{file.removeprefix(f'{who}.')}", "target": f"{SECRETS}/{file}"} for file in parcel.files
        ],
        "volumes": [f"./rows/{who}:{ROWS}"],
        "healthcheck": {
            "test": ["CMD", *parcel.probe],
            "interval": f"{PROBE_EVERY}s",
            "timeout": f"{PROBE_TIMEOUT}s",
            "retries": PROBE_RETRIES,
            "start_period": f"{start:g}s",  # a process that waits for the others is not unwell
        },
        "stop_grace_period": "30s",  # a recorder closes its file
    }
