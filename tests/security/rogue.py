"""A run in which node 3 is the enemy: it is played in this process, honestly on its own keys, and by its own means
(certificate, links, session) it does whatever a test wants. At one step it makes everybody wait while it attacks.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import psutil
import pytest
import zenoh

import duio_mesh
from duio_mesh import links, node
from duio_mesh.launcher import specs_of
from duio_mesh.mesh import Encoder, Keys, Mesh, security
from duio_mesh.run_folder import RunFolder
from duio_mesh.spec import NodeSpec, Wire, write_spec
from duio_mesh.supervisor import Supervisor
from duio_mesh.synthesis.design import Design
from duio_mesh.trace import Trace
from duio_mesh.wiring import Wiring
from tests.conftest import TOPOLOGIES

ME, VICTIM, BETWEEN = "node-3", "node-2", 100  # BETWEEN: the step at which everybody waits for node 3
STEPS = 200


def design_of(mode: str, topology: str = "ring", steps: int = STEPS) -> Design:
    """A topology with this security and a deadline that a loaded machine keeps."""
    changes = {"run.steps": steps, "run.deadline": 30.0, "security": mode}
    return duio_mesh.synthesise(duio_mesh.load_scenario(TOPOLOGIES / f"{topology}.yaml", **changes))


class Quiet:
    """A report that goes nowhere."""

    def __call__(self, event: str, **fields: Any) -> None: ...

    def beat(self) -> None: ...

    def warn(self, text: str) -> None: ...


class Gate:
    """An observer that stops before one step until it is told to go on."""

    def __init__(self, observer: Any, reached: SimpleQueue[None], go_on: threading.Event) -> None:
        self._observer, self._reached, self._go_on, self._k = observer, reached, go_on, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._observer, name)

    def sample(self, y: Any, u: Any) -> None:
        if self._k == BETWEEN:
            self._reached.put(None)
            self._go_on.wait(30)
        self._k += 1
        self._observer.sample(y, u)


class Siege:
    """The run as its enemy inside sees it."""

    def __init__(self, mesh: Mesh, specs: dict[str, Any], supervisor: Supervisor) -> None:
        self.session: zenoh.Session = mesh._session
        self.specs, self._supervisor = specs, supervisor
        self.keys = Keys(mesh.keys.run)

    def put(self, key: str, data: bytes) -> None:
        """Publish over the links of node 3; waits while they are full, so that nothing gets lost."""
        self.session.put(key, data, congestion_control=zenoh.CongestionControl.BLOCK)

    def forged(self, source: str, k: int, size: int = 9) -> bytes:
        """A perfect frame of another process of this run."""
        return Encoder(self.keys.run, source)(k, 0, np.full(size, 1e3))

    def memory(self) -> int:
        """Resident bytes of the victim's process."""
        for p in psutil.Process(self._supervisor._nursery.pid).children():
            if f"duio-{VICTIM}" in (p.name(), *p.cmdline()):
                return int(p.memory_info().rss)
        raise AssertionError("the victim is not there")


def besiege(
    design: Design, attack: Callable[[Siege], None], monkeypatch: pytest.MonkeyPatch
) -> tuple[Trace, dict[str, dict[str, int]]]:
    """Run the design with our own node 3, ``attack`` in the middle; the trace, and who refused how many frames."""
    reached, go_on, failed = SimpleQueue[None](), threading.Event(), SimpleQueue[BaseException]()
    meshes: list[Mesh] = []

    class Bad(Mesh):
        def __init__(self, wire: Wire, who: str, *rest: Any) -> None:
            super().__init__(wire, who, *rest)
            meshes.append(self)

    make = links.make_observer
    monkeypatch.setattr(links, "make_observer", lambda spec: Gate(make(spec), reached, go_on))
    monkeypatch.setattr(node, "Mesh", Bad)
    # our own side of the access control is ours to switch off
    monkeypatch.setattr(security, "access", lambda keys, guard: {"enabled": False})

    def play(spec: NodeSpec) -> None:
        try:
            node.run(spec, Quiet())  # type: ignore[arg-type]
        except BaseException as e:
            failed.put(e)
            reached.put(None)

    with Supervisor() as supervisor:
        folder = RunFolder.create(design.scenario.name, Path("run"))
        wiring = Wiring(design, folder.keys, record=False)
        specs = specs_of(design, folder, wiring.wires(), record=False, live=False)
        for who, spec in specs.items():
            write_spec(spec, folder.spec(who))
            if who != ME:
                logs = (folder.log(who, "jsonl"), folder.log(who, "err"))
                supervisor.start(who, who.split("-")[0], folder.spec(who), *logs)
        thread = threading.Thread(target=play, args=(specs[ME],), daemon=True)
        thread.start()
        reached.get(timeout=30)
        try:
            assert failed.empty(), failed.get()
            wiring.release()
            attack(Siege(meshes[0], specs, supervisor))
        finally:
            go_on.set()
        supervisor.watch(lambda: 0, 30.0)
        thread.join(30)
        assert failed.empty(), failed.get()
        return folder.gather(design), {who: p.done["rejected"] for who, p in supervisor.processes.items()}
