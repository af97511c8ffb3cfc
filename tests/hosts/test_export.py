"""What `launch.py export` writes: secrets in one container only, probes, addresses that exist; and what it refuses."""

from __future__ import annotations

import base64
import importlib.util
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from ruamel.yaml import YAML

import duio_mesh
from duio_mesh.cli import main
from duio_mesh.deploy import command
from duio_mesh.health import wire_of
from duio_mesh.mesh.keys import Keys
from duio_mesh.mesh.passage import passage
from duio_mesh.mesh.rules import data_key
from duio_mesh.spec import NodeSpec, PlantSpec, RecorderSpec, Wire, read_spec
from tests.conftest import TOPOLOGIES

TOPOLOGY = TOPOLOGIES / "three_hosts.yaml"
WHO = {"plant", "recorder", "node-1", "node-2", "node-3", "node-4"}
ROUTERS = {"router-hall", "router-north", "router-south"}
SITE = Path("site")
SECRETS = "/run/secrets/duio/"


def export(form: str, *settings: str) -> int:
    arguments = [argument for setting in settings for argument in ("--set", setting)]
    code = main([str(TOPOLOGY), "--dry-run", "--out", str(SITE), *arguments])
    return code or main(["export", str(SITE), f"--{form}"])


class Container:
    """One container of either form: what it runs, and the secret files that it sees (name -> bytes)."""

    def __init__(
        self, who: str, host: str, command: list[str], probes: list[list[str]], files: dict[str, bytes]
    ) -> None:
        self.who, self.host, self.command, self.probes, self.files = who, host, command, probes, files
        path = Path(f"{who}.spec")
        path.write_bytes(files[f"{who}.spec"])
        self.path, self.wire = path, wire_of(path)


def in_compose() -> Iterator[Container]:
    for path in sorted(SITE.glob("compose/*/compose.yaml")):
        document = YAML(typ="safe").load(path)
        mounted: list[str] = []
        for who, service in document["services"].items():
            mounted += [secret["source"] for secret in service["secrets"]]
            files = {}
            for secret in service["secrets"]:
                assert secret["target"].startswith(SECRETS)
                file = path.parent / document["secrets"][secret["source"]]["file"]
                assert stat.S_IMODE(file.stat().st_mode) == 0o600
                files[secret["target"].removeprefix(SECRETS)] = file.read_bytes()
            assert service["volumes"] == [f"./rows/{who}:/var/lib/duio"]
            assert (path.parent / "rows" / who).is_dir()
            assert service["read_only"] is True
            assert service["user"] == "1000:1000"
            check = service["healthcheck"]
            assert check["test"][0] == "CMD"
            assert check.keys() == {"test", "interval", "timeout", "retries", "start_period"}
            yield Container(who, path.parent.name, service["entrypoint"], [check["test"][1:]], files)
        assert sorted(mounted) == sorted(document["secrets"])  # each in one container, none in no container


def documents(name: str) -> list[dict[str, Any]]:
    return list(YAML(typ="safe").load_all(SITE / "kubernetes" / f"{name}.yaml"))


def in_kubernetes() -> Iterator[Container]:
    assert stat.S_IMODE((SITE / "kubernetes" / "secrets.yaml").stat().st_mode) == 0o600
    secrets = {d["metadata"]["name"]: d for d in documents("secrets")}
    jobs = [d for d in documents("run") if d["kind"] == "Job"]
    used = []
    for job in jobs:
        assert job["spec"]["backoffLimit"] == 0
        pod = job["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        volumes = {v["name"]: v for v in pod["volumes"]}
        names = [v["secret"]["secretName"] for v in pod["volumes"] if "secret" in v]
        used += names
        assert names == [job["metadata"]["name"]]
        (mount,) = (m for m in container["volumeMounts"] if m["mountPath"] + "/" == SECRETS)
        assert volumes[mount["name"]]["secret"]["secretName"] == names[0]
        assert pod["automountServiceAccountToken"] is False
        files = {name: base64.b64decode(data) for name, data in secrets[names[0]]["data"].items()}
        probes = [container[kind]["exec"]["command"] for kind in ("startupProbe", "livenessProbe")]
        host = pod["nodeSelector"]["kubernetes.io/hostname"]
        yield Container(container["name"], host, container["command"], probes, files)
    assert sorted(used) == sorted(secrets)


@pytest.mark.parametrize("transport", ["direct", "routed"])
@pytest.mark.parametrize("form", ["compose", "kubernetes"])
def test_each_container_gets_its_own_and_nobody_elses(form: str, transport: str) -> None:
    assert export(form, f"transport={transport}") == 0
    containers = list(in_compose() if form == "compose" else in_kubernetes())
    assert {c.who for c in containers} == (WHO | ROUTERS if transport == "routed" else WHO)
    assert len({c.wire.run for c in containers}) == 1
    assert {(c.wire.start, c.wire.lease) for c in containers} == {(600.0, 20.0)}  # run.deadline is 20 s
    for c in containers:
        module = c.command[2]
        assert c.command[:2] == ["python", "-m"]
        assert importlib.util.find_spec(module) is not None
        assert module == f"duio_mesh.{c.who.split('-')[0]}"
        assert c.command[3:5] == ["--spec", f"{SECRETS}{c.who}.spec"]
        assert c.probes == [["python", "-m", "duio_mesh.health", "--spec", f"{SECRETS}{c.who}.spec"]] * len(c.probes)
        assert c.files.keys() == {f"{c.who}.spec", "authority.pem", "certificate.pem", "key.pem"}
        assert c.wire.guard is not None
        assert (c.wire.guard.who, c.wire.guard.folder + "/") == (c.who, SECRETS)
        certificate = x509.load_pem_x509_certificate(c.files["certificate.pem"])
        (name,) = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
        assert name.value == c.who
        if c.who.startswith("node"):
            assert f"node-{read_spec(c.path, NodeSpec).id}" == c.who
    keys = {c.files["key.pem"] for c in containers}
    assert len(keys) == len(containers)
    everything = {c.who: b"".join(c.files.values()) for c in containers}
    for c in containers:
        assert [who for who, data in everything.items() if c.files["key.pem"] in data] == [c.who]
    assert not [p for p in SITE.rglob("*.pem") if form == "kubernetes"]
    assert_reachable(form, containers)


def assert_reachable(form: str, containers: list[Container]) -> None:
    """Whoever is dialled listens there and has a certificate for that name."""
    hosts = YAML(typ="safe").load(TOPOLOGY)["hosts"]
    listening = {}
    for c in containers:
        names = x509.load_pem_x509_certificate(c.files["certificate.pem"]).extensions
        subject = names.get_extension_for_class(x509.SubjectAlternativeName).value
        named = {
            str(v) for v in (*subject.get_values_for_type(x509.IPAddress), *subject.get_values_for_type(x509.DNSName))
        }
        runs = hosts[c.host]["runs"]
        assert c.who in (f"router-{c.host}", *(f"node-{who}" if isinstance(who, int) else who for who in runs))
        for endpoint in c.wire.listen:
            protocol, address, port = re.fullmatch(r"(\w+)/(.+):(\d+)", endpoint).groups()  # type: ignore[union-attr]
            assert protocol == "tls"
            if form == "compose":
                assert address == hosts[c.host]["address"]
                assert address in named
                dialled = endpoint
            else:
                services = [d for d in documents("run") if d["kind"] == "Service"]
                jobs = {
                    d["metadata"]["name"]: d["spec"]["template"]["metadata"]["labels"]
                    for d in documents("run")
                    if d["kind"] == "Job"
                }
                chosen = {
                    s["metadata"]["name"]: [
                        j for j, labels in jobs.items() if s["spec"]["selector"].items() <= labels.items()
                    ]
                    for s in services
                }
                assert all(len(j) == 1 for j in chosen.values())
                own = [s for s, (job,) in chosen.items() if jobs[job]["duio-mesh/process"] == c.who]
                if c.who == "recorder":
                    assert own == []  # nobody dials it
                    continue
                assert re.fullmatch(r"[a-z]([a-z0-9-]{0,61}[a-z0-9])?", own[0])
                assert own[0] in named
                assert {"127.0.0.1"} <= named  # its probe
                dialled = f"tls/{own[0]}:{port}"
            assert dialled not in listening
            listening[dialled] = c.who
    for c in containers:
        assert set(c.wire.connect) <= listening.keys()


def test_an_image_is_a_reference(capsys: pytest.CaptureFixture[str]) -> None:
    for text in ("a b;c", "", "Upper", "a:b:c", "a\n", "http://a/b", "a@sha256:1"):
        with pytest.raises(SystemExit) as ended:
            main(["export", "nothing", "--compose", "--image", text])
        assert ended.value.code == 2
        assert "should be an image like" in capsys.readouterr().err
    for text in (command.IMAGE, "localhost:5000/a/b", "R.example/a__b-c.d:V1.0", f"[::1]:5000/a:1@sha256:{'0' * 64}"):
        assert main(["export", "nothing", "--compose", "--image", text]) != 0  # there is no such run
        assert "image" not in capsys.readouterr().err


@pytest.mark.parametrize("form", ["compose", "kubernetes"])
def test_an_open_run_has_to_be_asked_for_by_name(form: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(form, "security=open") == 2
    assert "beyond this host, needs 'password' or 'mtls'" in capsys.readouterr().err
    assert not [p for p in SITE.rglob("*") if p.is_file() and form in p.parts]


def test_an_open_run_that_was_asked_for_by_name_has_no_credentials() -> None:
    assert export("compose", "security={mode: open, exposed: true}") == 0
    for path in SITE.glob("compose/*/secrets/*/*"):
        assert path.suffix == ".spec"
        assert wire_of(path).guard is None
        assert all(endpoint.startswith("tcp/") for endpoint in wire_of(path).listen)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["export", "nowhere", "--compose"], "nowhere holds no design"),
        (["export", "site", "--compose"], "already exists and is not empty"),
        (["gather", "site", "site/compose", "--out", "site"], "already exists and is not an empty folder"),
    ],
)
def test_what_cannot_be_done_is_said(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert export("compose") == 0
    (SITE / "compose" / "plant.f64").touch()  # something to gather
    assert main(arguments) in (2, 3)
    assert said in capsys.readouterr().err


def test_without_hosts_there_is_no_compose_file_but_a_cluster_places_the_pods(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ring = str(TOPOLOGIES / "ring.yaml")
    assert main([ring, "--dry-run", "--out", "ring", "--set", "security=mtls"]) == 0
    assert main(["export", "ring", "--compose"]) == 2
    assert "hosts: are missing" in capsys.readouterr().err
    assert main(["export", "ring", "--kubernetes"]) == 0
    jobs = [d for d in YAML(typ="safe").load_all(Path("ring/kubernetes/run.yaml")) if d["kind"] == "Job"]
    assert len(jobs) == 6
    assert not any("nodeSelector" in job["spec"]["template"]["spec"] for job in jobs)


def test_a_router_lets_pass_only_what_comes_from_the_side_of_its_sender() -> None:
    assert export("compose", "transport=routed", "hosts.south.via=north") == 0
    spec = {path.stem: wire_of(path) for path in SITE.glob("compose/*/secrets/router-*/*.spec")}
    side = {
        "router-hall": {"plant", "recorder", "node-1"},
        "router-north": {"node-2", "node-3"},
        "router-south": {"node-4"},
    }
    line = ["router-hall", "router-north", "router-south"]  # who dials whom
    assert [len(spec[r].connect) for r in line] == [0, 1, 1]
    arcs = {(f"node-{a.source}", f"node-{a.target}") for a in duio_mesh.load_scenario(TOPOLOGY).graph.arcs}
    nodes = {f"node-{i}" for i in range(1, 5)}
    pairs = arcs | {("plant", n) for n in nodes} | {(n, "plant") for n in nodes}
    pairs |= {(w, "recorder") for w in nodes | {"plant"}}
    for at, router in enumerate(line):
        wire: Wire = spec[router]
        assert wire.guard is not None
        keys = Keys(wire.run)
        found = passage(keys, wire.guard)
        assert found["default_permission"] == "deny"
        beyond = {w: {w} for w in side[router]}
        if at > 0:
            beyond[line[at - 1]] = set().union(*(side[r] for r in line[:at]))
        if at < 2:
            beyond[line[at + 1]] = set().union(*(side[r] for r in line[at + 1 :]))
        for neighbour, there in beyond.items():
            granted = {i for p in found["policies"] if p["subjects"] == [neighbour] for i in p["rules"]}
            (subject,) = (s for s in found["subjects"] if s["id"] == neighbour)
            assert subject["cert_common_names"] == [neighbour]
            rules = [r for r in found["rules"] if r["id"] in granted]
            puts = {k for r in rules if r["messages"] == ["put"] and r["flows"] == ["ingress"] for k in r["key_exprs"]}
            assert puts == {data_key(keys, s, t) for s, t in pairs if s in there and t not in there}
            out = {k for r in rules if r["messages"] == ["put"] and r["flows"] == ["egress"] for k in r["key_exprs"]}
            assert out == {data_key(keys, s, t) for s, t in pairs if s not in there and t in there}
            alive = {
                k
                for r in rules
                if r["messages"] == ["liveliness_token"] and r["flows"] == ["ingress"]
                for k in r["key_exprs"]
            }
            assert alive == {keys.alive(f"{who}/**") for who in there}  # each of its own lives


def test_the_recorder_writes_down_what_everybody_tells_it() -> None:
    assert export("compose") == 0
    secrets = SITE / "compose" / "hall" / "secrets"
    assert read_spec(secrets / "recorder" / "recorder.spec", RecorderSpec).kept
    assert read_spec(secrets / "plant" / "plant.spec", PlantSpec).kept
    assert read_spec(secrets / "node-1" / "node-1.spec", NodeSpec).kept
