"""A run as objects of a Kubernetes cluster: one secret and one job per process, a service where it is dialled."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
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
from duio_mesh.deploy.places import PORT, in_cluster, object_name
from duio_mesh.simulation import estimate_sizes
from duio_mesh.synthesis.design import Design

UID = 1000  # of the image's user
READABLE = 0o440  # by the group of the pod
FIRST_PROBE = 10  # seconds between probes of a process that is still starting
GIB = 2**30
ORDER = """\
The processes of {name}, written by `launch.py export --kubernetes`.
kubectl apply -f secrets.yaml && kubectl apply -f run.yaml   # starts the run
kubectl apply -f results.yaml         # afterwards: a pod that shows what the recorder wrote"""


def export(design: Design, out: Path, image: str, start: float) -> list[Path]:
    """Write OUT/secrets.yaml (mode 0600), OUT/run.yaml and OUT/results.yaml; their paths. Raises as ``bundle.pack``."""
    scenario = design.scenario
    sites = in_cluster(scenario)
    out.mkdir(parents=True, exist_ok=True)
    parcels = pack(design, sites, out / "secrets", start)
    labels = {"app.kubernetes.io/part-of": object_name(scenario, "run")}
    described = [(parcel, _meta(object_name(scenario, parcel.who), parcel.who, labels)) for parcel in parcels]
    claim = object_name(scenario, "results")
    head = ORDER.format(name=scenario.name)
    secrets = [_secret(parcel, meta) for parcel, meta in described]
    services = [_service(meta) for parcel, meta in described if _dialled(parcel)]
    jobs = [_job(parcel, meta, image, start, claim) for parcel, meta in described]
    volume = [_claim(_meta(claim, "recorder", labels), _bytes(design))] if sites.record else []
    write_documents(out / "secrets.yaml", head, secrets, mode=0o600)
    write_documents(out / "run.yaml", head, [*volume, *services, *jobs])
    written = [out / "secrets.yaml", out / "run.yaml"]
    if sites.record:
        pod = _results(_meta(object_name(scenario, "show"), "show", labels), image, claim)
        write_documents(out / "results.yaml", head, [pod])
        written.append(out / "results.yaml")
    for parcel in parcels:
        for path in parcel.files.values():
            path.unlink()
        (out / "secrets" / parcel.who).rmdir()
    (out / "secrets").rmdir()
    return written


def _dialled(parcel: Parcel) -> bool:
    return bool(parcel.place.dial) and parcel.who != "recorder"


def _meta(name: str, who: str, labels: Mapping[str, str]) -> dict[str, Any]:
    return {"name": name, "labels": {**labels, "app.kubernetes.io/name": "duio-mesh", "duio-mesh/process": who}}


def _secret(parcel: Parcel, meta: Mapping[str, Any]) -> dict[str, Any]:
    data = {name: base64.b64encode(path.read_bytes()).decode() for name, path in parcel.files.items()}
    return {"apiVersion": "v1", "kind": "Secret", "metadata": meta, "immutable": True, "type": "Opaque", "data": data}


def _service(meta: Mapping[str, Any]) -> dict[str, Any]:
    """The name under which a process is dialled: also before it is ready, or nobody would ever be."""
    ports = [{"name": "zenoh", "port": PORT, "protocol": "TCP"}]
    spec = {"selector": meta["labels"], "ports": ports, "publishNotReadyAddresses": True}
    return {"apiVersion": "v1", "kind": "Service", "metadata": meta, "spec": spec}


def _job(parcel: Parcel, meta: Mapping[str, Any], image: str, start: float, claim: str) -> dict[str, Any]:
    """Started once and never again: a process that has lost its run has nothing to come back to."""
    storage = {"persistentVolumeClaim": {"claimName": claim}} if parcel.who == "recorder" else {"emptyDir": {}}
    probe = {"exec": {"command": parcel.probe}, "timeoutSeconds": PROBE_TIMEOUT}
    container = _container(parcel.who, image, parcel.command) | {
        "volumeMounts": [
            {"name": "secrets", "mountPath": SECRETS, "readOnly": True},
            {"name": "rows", "mountPath": ROWS},
            {"name": "tmp", "mountPath": "/tmp"},  # noqa: S108  (in the container)
        ],
        "startupProbe": {
            **probe,
            "periodSeconds": FIRST_PROBE,
            "failureThreshold": math.ceil(start / FIRST_PROBE) + PROBE_RETRIES,
        },
        "livenessProbe": {**probe, "periodSeconds": PROBE_EVERY, "failureThreshold": PROBE_RETRIES},
    }
    volumes = [
        {"name": "secrets", "secret": {"secretName": meta["name"], "defaultMode": READABLE}},
        {"name": "rows", **storage},
        {"name": "tmp", "emptyDir": {}},
    ]
    pod = _pod(container, volumes)
    if parcel.place.host:
        pod["nodeSelector"] = {"kubernetes.io/hostname": parcel.place.host}
    template = {"metadata": {"labels": meta["labels"]}, "spec": pod}
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": meta,
        "spec": {"backoffLimit": 0, "template": template},
    }


def _container(name: str, image: str, command: list[str]) -> dict[str, Any]:
    return {
        "name": name,
        "image": image,
        "command": command,
        "env": [{"name": key, "value": value} for key, value in ENVIRONMENT.items()],
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
    }


def _pod(container: dict[str, Any], volumes: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "terminationGracePeriodSeconds": 30,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": UID,
            "runAsGroup": UID,
            "fsGroup": UID,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [container],
        "volumes": volumes,
    }


def _claim(meta: Mapping[str, Any], size: int) -> dict[str, Any]:
    request = {"requests": {"storage": f"{math.ceil(size / GIB)}Gi"}}
    spec = {"accessModes": ["ReadWriteOnce"], "resources": request}
    return {"apiVersion": "v1", "kind": "PersistentVolumeClaim", "metadata": meta, "spec": spec}


def _bytes(design: Design) -> int:
    """What the recorder writes at most: every row as it is, and again in the recording, with room to spare."""
    rows = design.scenario.plant.n + sum(estimate_sizes(design).values())
    return 4 * 8 * rows * design.plant.steps


def _results(meta: Mapping[str, Any], image: str, claim: str) -> dict[str, Any]:
    """A pod that does nothing but hold the recorder's volume, for `kubectl cp`."""
    wait = ["python", "-c", "import signal; signal.signal(signal.SIGTERM, lambda *_: exit()); signal.pause()"]
    container = _container("show", image, wait) | {"volumeMounts": [{"name": "rows", "mountPath": ROWS}]}
    volumes = [{"name": "rows", "persistentVolumeClaim": {"claimName": claim}}]
    return {"apiVersion": "v1", "kind": "Pod", "metadata": meta, "spec": _pod(container, volumes)}
