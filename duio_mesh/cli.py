"""The command line: `python launch.py TOPOLOGY`. Reads, designs, runs, and says what came of it.

Exit codes: 0 converged, 1 ran but did not converge, 2 the file or the design is impossible (nothing was started),
3 a run failed, 130 interrupted.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from duio_mesh import __version__
from duio_mesh.errors import DesignError, RunError, ScenarioError

if TYPE_CHECKING:
    from duio_mesh.launcher import RunResult
    from duio_mesh.supervisor import Supervisor
    from duio_mesh.synthesis.design import Design

FEW = 8  # warnings that are shown when a run fails
CONVERGED, NOT_CONVERGED, IMPOSSIBLE, FAILED, INTERRUPTED = 0, 1, 2, 3, 130

EPILOG = """\
exit codes: 0 converged as the file asks, 1 ran but did not converge, 2 the file or the design is impossible (nothing
was started), 3 a run failed (the message names the process or the edge), 130 interrupted.

examples:
  python launch.py topologies/partitioned.yaml
  python launch.py topologies/ring.yaml --steps 2000 --seed 7 --plot
  python launch.py topologies/ring.yaml --set plant.noise.variance=0 --set graph.edges='[[1,2],[3,4]]'
  python launch.py topologies/six_state_ring.yaml --check
  python launch.py replay runs/heat-ring/latest --node 3   (one node again, alone, from its inputs; replay --help)
  python launch.py new heat --rooms 8x8 --nodes 16 --out topologies/heat8x8.yaml   (new --help: write a topology file)
  python launch.py export runs/site --compose   (export --help: containers on many hosts; gather --help: their results)
"""


def parser() -> argparse.ArgumentParser:
    """The options of the command line (docs/design.md, section 4)."""
    p = argparse.ArgumentParser(
        prog="launch.py",
        description="Run a distributed unknown-input observer as real processes that talk over Zenoh along a graph.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("topology", type=Path, help="topology file (docs/topology-file.md)")
    p.add_argument("--steps", type=int, metavar="K", help="samples to run, instead of run.steps")
    p.add_argument("--seed", type=int, metavar="S", help="seed of initial state and noise, instead of run.seed")
    p.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default runs/<name>/<UTC time>)")
    how = p.add_mutually_exclusive_group()
    how.add_argument("--in-process", action="store_true", help="the oracle: one process, no Zenoh, the same bits")
    how.add_argument("--check", action="store_true", help="validate, check the theory, design, start nothing")
    how.add_argument("--dry-run", action="store_true", help="print what would be started; with --out keep the design")
    p.add_argument(
        "--contingency",
        type=int,
        metavar="K",
        help="with --check: what is left when up to K edges or nodes are lost (docs/contingency.md)",
    )
    p.add_argument("--live", action="store_true", help="also serve the recording to a Rerun viewer on this host")
    p.add_argument("--plot", action="store_true", help="write PNG figures of the errors and states into the results")
    p.add_argument("--no-record", action="store_true", help="no recorder process, no recording.rrd")
    p.add_argument("--inputs", action="store_true", help="keep each node's inputs, for `replay` (docs/replay.md)")
    p.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PATH=VALUE",
        dest="overrides",
        help="override a value of the resolved file, e.g. plant.noise.variance=0 (YAML; may be repeated)",
    )
    p.add_argument("--version", action="version", version=f"duio_mesh {__version__}")
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        return _command(argv)
    except (ScenarioError, DesignError) as e:
        print(e, file=sys.stderr)
        return IMPOSSIBLE
    except (RunError, OSError) as e:  # OSError: a full disk, a folder that may not be written
        said = getattr(e, "warnings", ())
        for warning in said[:FEW]:
            print(f"warning: {warning}", file=sys.stderr)
        if len(said) > FEW:
            print(f"and {len(said) - FEW} further warnings (logs/)", file=sys.stderr)
        print(f"run failed: {e}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return INTERRUPTED


def _command(argv: Sequence[str]) -> int:
    """Carry out the command that the arguments ask for."""
    command = argv[0] if argv else ""
    if command in ("export", "gather"):
        from duio_mesh.deploy import command as deploy

        return deploy.main(argv)
    if command == "new":
        from duio_mesh.generate import command as generate

        return generate.main(argv[1:])
    if command == "replay":
        from duio_mesh import replay

        return replay.main(argv[1:])
    args = parser().parse_args(argv)
    if args.contingency is not None and not args.check:
        parser().error("--contingency says what a design is worth on other graphs: use it with --check")
    if args.live and (args.no_record or args.in_process or args.check or args.dry_run):
        parser().error("--live shows what the recorder process of a run records: use it without the others")
    return _main(args)


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _main(args: argparse.Namespace) -> int:
    from duio_mesh import synthesis
    from duio_mesh.scenario import load_scenario

    flags = {"run.steps": args.steps, "run.seed": args.seed, "run.inputs": "true" if args.inputs else None}
    overrides = args.overrides + [f"{path}={value}" for path, value in flags.items() if value is not None]
    scenario = load_scenario(args.topology, overrides, options_of=synthesis.options_of)
    if scenario.outside and args.in_process:
        raise ScenarioError(
            ["--in-process: the measurements of this file come from outside (external:), which only processes can hear"]
        )
    if args.out:
        _check_out(args.out)

    from duio_mesh import console
    from duio_mesh.synthesis.contingency import with_contingency

    processes = not (args.in_process or args.check or args.dry_run)
    with _nursery(recorder=not args.no_record) if processes else contextlib.nullcontext() as supervisor:
        with console.working("designing the observers") as say:
            design = synthesis.synthesise(scenario, say)
            if args.contingency is not None:
                design = with_contingency(design, args.contingency, say)
        if args.check:
            console.certificate(design)
            return CONVERGED
        if args.dry_run:
            console.plan(design, record=not args.no_record)
            if args.out:
                from duio_mesh.deploy.stored import write_design

                console.written("design", write_design(design, args.out))
            return CONVERGED
        result = _run(design, args, supervisor)
    console.result(design, result, live=args.live)
    return CONVERGED if result.converged else NOT_CONVERGED


def _check_out(out: Path) -> None:
    """Before a design that may take long. Raises ScenarioError where nothing can be written."""
    if out.exists() and not out.is_dir():
        raise ScenarioError([f"--out {out}: is not a folder"])
    if out.exists() and any(out.iterdir()):
        raise ScenarioError([f"--out {out}: already exists and is not empty; a run is never overwritten"])
    there = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        raise ScenarioError([f"--out {out}: nothing can be written in {there}"])


@contextlib.contextmanager
def _nursery(*, recorder: bool) -> Iterator[Supervisor]:
    """A nursery that gets ready while the gains are designed, and perhaps a recorder in it."""
    from duio_mesh.supervisor import Supervisor

    with Supervisor() as supervisor:
        if recorder:
            supervisor.prepare("recorder")
        yield supervisor


def _run(design: Design, args: argparse.Namespace, supervisor: Supervisor | None) -> RunResult:
    """Run the design as asked, with progress, and draw the figures."""
    from duio_mesh import console, launcher

    console.clock(design, processes=supervisor is not None)
    with console.progress(design) as show:
        if supervisor is None:
            result = launcher.run_in_process(design, args.out, record=not args.no_record, show=show)
        else:
            result = launcher.run(
                design,
                args.out,
                record=not args.no_record,
                live=args.live,
                show=show,
                watcher=console.Watcher() if args.live else None,
                supervisor=supervisor,
            )
    if args.plot:
        from duio_mesh.report.figures import figures

        with console.working("drawing the figures"):
            figures(result.folder, design.scenario, result.trace)
    return result
