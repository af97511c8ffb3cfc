"""Hosts on this machine: network namespaces on wires with a delay (in user space) and a rate (tbf of the kernel).

Every host is a namespace with a TAP device; a thread of this process is the wire between them: it holds every Ethernet
frame for the one-way delay and hands it to its receiver. (Where the kernel has netem that would do the same; many
container kernels do not have it.) Needs root, iproute2 and /dev/net/tun.
"""

from __future__ import annotations

import contextlib
import fcntl
import heapq
import os
import select
import struct
import subprocess
import threading
import time
from types import TracebackType
from typing import Self

from interleave import Missing

TUNSETIFF, TAP, NO_INFO = 0x400454CA, 0x0002, 0x1000
FRAME = 2048
BURST = "burst 4kb latency 400ms"


def address(host: int) -> str:
    """IPv4 address of a host."""
    return f"10.77.0.{host + 1}"


def _mac(host: int) -> bytes:
    return bytes((2, 0, 0, 0, 0, host + 1))


class Wires:
    """``count`` hosts on one switch with a delay; gone with the ``with``."""

    def __init__(self, count: int, delay: float = 0.0, rate: float = 0.0) -> None:
        """``delay``: seconds one way; ``rate``: bits per second that a host may send, 0 for as fast as it can."""
        self._count, self._delay, self._rate = count, delay, rate
        self._taps: list[int] = []
        self._over = False
        self._stop, self._stopped = os.pipe()
        self._wire = threading.Thread(target=self._carry, name="wire", daemon=True)

    def namespace(self, host: int) -> str:
        """Its name."""
        return f"duio-bench-{os.getpid()}-{host}"

    def inside(self, host: int, command: list[str]) -> list[str]:
        """The command that runs ``command`` on this host."""
        return ["ip", "netns", "exec", self.namespace(host), *command]

    def __enter__(self) -> Self:
        """Raises Missing where the machine does not allow it."""
        try:
            for host in range(self._count):
                self._add(host)
        except (OSError, subprocess.CalledProcessError) as e:
            self._remove()
            said = e.stderr.strip() if isinstance(e, subprocess.CalledProcessError) else str(e)
            raise Missing(f"no network namespaces here: {said}") from None
        self._wire.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        os.write(self._stopped, b"x")
        self._wire.join()
        self._remove()

    def _add(self, host: int) -> None:
        tap, name, where = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK), f"duio{host}", self.namespace(host)
        self._taps.append(tap)
        fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH", name.encode(), TAP | NO_INFO))
        mac = _mac(host).hex(":")
        _run(f"ip netns add {where}")
        _run(f"ip link set {name} address {mac} netns {where}")
        _run(f"ip -n {where} address add {address(host)}/24 dev {name}")
        _run(f"ip -n {where} link set {name} up")
        _run(f"ip -n {where} link set lo up")
        if self._rate:
            _run(f"tc -n {where} qdisc add dev {name} root tbf rate {self._rate:.0f}bit {BURST}")

    def _remove(self) -> None:
        for host, tap in enumerate(self._taps):
            with contextlib.suppress(subprocess.CalledProcessError):
                _run(f"ip netns del {self.namespace(host)}")
            os.close(tap)
        os.close(self._stop)
        os.close(self._stopped)

    def _carry(self) -> None:
        """Frames from their senders to their receivers, each after the delay."""
        held: list[tuple[float, int, int, bytes]] = []  # (when, number, receiver, frame)
        to = {_mac(host): [host] for host in range(self._count)}
        number = 0
        while True:
            wait = max(0.0, held[0][0] - time.monotonic()) if held else None
            ready, _, _ = select.select([*self._taps, self._stop], [], [], wait)
            if self._stop in ready:
                return
            now = time.monotonic()
            for sender, tap in enumerate(self._taps):
                with contextlib.suppress(BlockingIOError):
                    while tap in ready:
                        frame = os.read(tap, FRAME)
                        everybody = [host for host in range(self._count) if host != sender]
                        for host in to.get(frame[:6], everybody):
                            number += 1
                            heapq.heappush(held, (now + self._delay, number, host, frame))
            while held and held[0][0] <= now:
                _, _, host, frame = heapq.heappop(held)
                with contextlib.suppress(BlockingIOError, OSError):  # a full or closed device drops it, as a wire does
                    os.write(self._taps[host], frame)


def _run(command: str) -> None:
    subprocess.run(command.split(), check=True, capture_output=True, text=True)
