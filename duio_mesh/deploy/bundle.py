"""What each process of a deployment is given, as files: its own spec and its own credentials, nobody else's."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from duio_mesh.deploy.places import Place, Sites
from duio_mesh.deploy.wires import SiteWiring
from duio_mesh.errors import ScenarioError
from duio_mesh.launcher import specs_of
from duio_mesh.run_folder import RunFolder
from duio_mesh.spec import AnySpec, RouterSpec, write_spec
from duio_mesh.synthesis.design import Design

SECRETS = "/run/secrets/duio"  # in a container: its spec and credentials, read only
ROWS = "/var/lib/duio"  # in a container: its journal and log, to be collected
THREADS = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
ENVIRONMENT = THREADS | {"PYTHONDONTWRITEBYTECODE": "1"}
PROBE_EVERY, PROBE_TIMEOUT, PROBE_RETRIES = 30, 10, 3  # seconds, seconds


class _InContainer(RunFolder):
    """Where a process in a container finds its files."""

    def rows(self, who: str) -> Path:
        return self.root / f"{who}.f64"

    def inputs(self, who: str) -> Path:
        return self.root / f"{who}.tape"


@dataclass(frozen=True)
class Parcel:
    """One process: where it is, and its secret files by the names that it knows them by."""

    who: str
    place: Place
    files: Mapping[str, Path]

    @property
    def command(self) -> list[str]:
        """What a container runs."""
        spec, log = f"{SECRETS}/{self.who}.spec", f"{ROWS}/{self.who}.jsonl"
        return ["python", "-m", f"duio_mesh.{self.who.split('-')[0]}", "--spec", spec, "--log", log]

    @property
    def probe(self) -> list[str]:
        """What asks whether it is alive."""
        return ["python", "-m", "duio_mesh.health", "--spec", f"{SECRETS}/{self.who}.spec"]


def pack(design: Design, sites: Sites, root: Path, start: float) -> list[Parcel]:
    """Write one folder of secrets per process below ``root`` (folders 0700, files 0600); all processes and routers.

    Raises ScenarioError where ``SiteWiring`` does.
    """
    if design.plant.outside:
        raise ScenarioError(["plant: measurements from outside cannot be exported yet: their gateway has no place"])
    wiring = SiteWiring(design, sites, keys=root, secrets_at=SECRETS, start=start)
    specs = specs_of(design, _InContainer(Path(ROWS)), wiring.wires(), record=sites.record, live=False)
    specs |= wiring.routers()
    places = {**sites.places, **sites.routers}
    parcels = []
    for who, spec in specs.items():
        folder = root / who
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_spec(_kept(spec) if sites.record else spec, folder / f"{who}.spec")
        parcels.append(Parcel(who, places[who], {path.name: path for path in sorted(folder.iterdir())}))
    return parcels


def _kept(spec: AnySpec) -> AnySpec:
    """Without a shared disk the recorder writes down what everybody tells it."""
    return spec if isinstance(spec, RouterSpec) else replace(spec, kept=True)
