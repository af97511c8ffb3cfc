"""The life of a router process: `python -m duio_mesh.router --spec router-north.spec`.

For hosts that cannot reach each other (`transport: routed`). It is a Zenoh session in router mode and does what Zenoh's
own router does; what it lets pass is in its spec. It ends when the last process of the run has gone.
"""

from __future__ import annotations

from queue import Empty, SimpleQueue

from duio_mesh.errors import RunError
from duio_mesh.mesh import Mesh
from duio_mesh.process import Report, main
from duio_mesh.spec import RouterSpec


def run(spec: RouterSpec, report: Report) -> None:
    """Route until everybody has come and gone. Raises RunError when not all have come before the wire's start."""
    news = SimpleQueue[tuple[str, bool]]()
    with Mesh(spec.wire, spec.who, report.warn) as mesh:
        mesh.watch(lambda member, alive: news.put((member.who, alive)))
        report("ready")
        seen: set[str] = set()
        here: set[str] = set()
        while here or not seen >= {*spec.carries}:
            try:
                who, alive = news.get(timeout=None if here else spec.wire.start)
            except Empty:
                missing = ", ".join(sorted({*spec.carries} - seen))
                raise RunError(f"{spec.who}: nobody is here, and these never came: {missing}") from None
            if who in spec.carries:
                seen.add(who)
                (here.add if alive else here.discard)(who)
    report("done", rejected={})


if __name__ == "__main__":
    main(RouterSpec, run)
