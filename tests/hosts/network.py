"""Hosts to test with: network namespaces on a bridge, and containers as a compose file describes them, without Docker.

Everything is in namespaces of its own (the bridge, too), so that removing those removes everything.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest
from ruamel.yaml import YAML

SWITCH = "switch"
LIMIT = "rate 200kbit burst 4kb latency 400ms"
TRIED = f"ip link add name b0 type bridge && tc qdisc add dev lo root tbf {LIMIT} && mount -t tmpfs none /run"
CONTAINER = """
mount -t tmpfs none /run
mount -t tmpfs none /var/lib
mkdir -p "$1" && mount --bind "$2" "$1"
shift 2
while [ "$1" != -- ]; do mkdir -p "${1%/*}" && cp "$2" "$1" && chmod 400 "$1"; shift 2; done
shift
exec "$@"
"""


def need_namespaces() -> None:
    """Skip the test where the machine does not allow network namespaces."""
    missing = [tool for tool in ("ip", "tc", "nsenter") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed (iproute2, util-linux): no hosts to test with")
    covered = [home for home in ("/run", "/var/lib") if Path(sys.executable).is_relative_to(home)]
    if covered:
        pytest.skip(f"Python itself is in {covered[0]}, which the stand-in for a container hides")
    name = f"duio-{os.getpid()}-try"
    tried = subprocess.run(
        f"ip netns add {name} && ip netns exec {name} sh -c '{TRIED}'; code=$?; ip netns del {name}; exit $code",
        shell=True,
        capture_output=True,
        text=True,
    )
    if tried.returncode:
        pytest.skip(f"this machine does not allow network namespaces: {tried.stderr.strip()}")


class Network:
    """Hosts by name and address, all on one bridge; gone with the ``with``, and so are their processes."""

    def __init__(self, addresses: Mapping[str, str]) -> None:
        self._addresses = addresses
        self.containers: dict[str, Container] = {}

    def namespace(self, host: str) -> str:
        return f"duio-{os.getpid()}-{host}"

    def __enter__(self) -> Self:
        try:
            self._run(f"ip netns add {self.namespace(SWITCH)}")
            self.at(SWITCH, "ip link add name br0 type bridge", "ip link set br0 up")
            for host, address in self._addresses.items():
                self._run(f"ip netns add {self.namespace(host)}")
                self.at(
                    SWITCH,
                    f"ip link add name {host} type veth peer name eth0 netns {self.namespace(host)}",
                    f"ip link set {host} master br0 up",
                )
                self.at(host, f"ip address add {address}/24 dev eth0", "ip link set eth0 up", "ip link set lo up")
        except BaseException:
            self._remove()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._remove()

    def at(self, host: str, *commands: str) -> None:
        """Run commands on a host, or on the switch."""
        for command in commands:
            self._run(f"ip netns exec {self.namespace(host)} {command}")

    def up(self, folder: Path, *, without: str = "") -> None:
        """What ``docker compose up`` does in each host's folder of an export, for all that are not up yet."""
        for host in self._addresses:
            document = YAML(typ="safe").load(folder / host / "compose.yaml")
            for who, service in document["services"].items():
                if who not in self.containers and who != without:
                    self.containers[who] = Container(self.namespace(host), folder / host, service, document["secrets"])

    def reaches(self, host: str, address: str) -> bool:
        """Whether something that listens on another host's first port can be dialled."""
        code = f"import socket; socket.create_connection(('{address}', 7447), 0.5)"
        command = ["ip", "netns", "exec", self.namespace(host), sys.executable, "-c", code]
        return subprocess.run(command, capture_output=True).returncode == 0

    def limit(self, host: str) -> None:
        """Limit the bandwidth between a host and all others, in both directions."""
        self.at(host, f"tc qdisc add dev eth0 root tbf {LIMIT}")
        self.at(SWITCH, f"tc qdisc add dev {host} root tbf {LIMIT}")

    def held_up(self, host: str) -> int:
        """How many packets of a host had to wait for the limit."""
        command = ["ip", "netns", "exec", self.namespace(host), "tc", "-s", "-j", "qdisc", "show", "dev", "eth0"]
        (statistics,) = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        return int(statistics["overlimits"])

    def ended(self, timeout: float = 60.0) -> dict[str, int]:
        """Wait for all containers; their exit codes."""
        for container in self.containers.values():
            container.process.wait(timeout)
        return {who: container.process.returncode for who, container in self.containers.items()}

    def said(self) -> str:
        """What all containers wrote, for a test that fails."""
        return "\n".join(f"{who}: {container.output()}" for who, container in self.containers.items())

    @staticmethod
    def _run(command: str) -> None:
        subprocess.run(command.split(), check=True, capture_output=True, text=True)

    def _remove(self) -> None:
        for container in self.containers.values():
            container.kill()
        for host in (*self._addresses, SWITCH):
            subprocess.run(["ip", "netns", "del", self.namespace(host)], capture_output=True)


class Container:
    """One service of a compose file: in its host's network, with its own secrets and its own volume, and no other."""

    def __init__(self, namespace: str, folder: Path, service: Mapping[str, Any], secrets: Mapping[str, Any]) -> None:
        assert service["network_mode"] == "host"
        (volume,) = service["volumes"]
        source, target = volume.split(":")
        mounts = [target, str(folder / source)]
        for secret in service["secrets"]:
            mounts += [secret["target"], str(folder / secrets[secret["source"]]["file"])]
        self._service = service
        self._log = (folder / f"{service['entrypoint'][2]}.{os.urandom(4).hex()}.out").open("w+")
        self.process = subprocess.Popen(
            ["ip", "netns", "exec", namespace, "sh", "-euc", CONTAINER, "sh", *mounts, "--", *self._here("entrypoint")],
            stdout=self._log,
            stderr=subprocess.STDOUT,
            env=os.environ | service["environment"],
        )

    def healthy(self, *options: str) -> bool:
        """What its health check says."""
        command = ["nsenter", "-t", str(self.process.pid), "-m", "-n", "--", *self._here("healthcheck"), *options]
        return subprocess.run(command, capture_output=True, timeout=20).returncode == 0

    def output(self) -> str:
        """Standard output and error."""
        return Path(self._log.name).read_text()

    def kill(self) -> None:
        """End it if it is still there."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self._log.close()

    def _here(self, what: str) -> list[str]:
        """Its command with the Python of this machine."""
        command = self._service["healthcheck"]["test"][1:] if what == "healthcheck" else self._service["entrypoint"]
        assert command[0] == "python"
        return [sys.executable, *command[1:]]
