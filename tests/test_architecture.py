"""Who may import whom (docs/design.md), read from the source, and what a node process has really loaded."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.conftest import ROOT

PACKAGE = ROOT / "duio_mesh"

# from the ground up; a file may import from its own floor and the floors below
FLOORS = [
    [
        "arrays",
        "errors",
        "faults",
        "methods",
        "spec",
        "trace",
        "dynamics",
        "geometry",
        "scenario",
        "observers",
        "mesh",
        "sensors",
        "journal",
        "ledger",
        "tape",
    ],
    ["report", "process"],
    ["links", "credits"],
    ["synthesis", "simulation", "node", "plant", "gateway", "recorder", "router", "health"],
    ["nursery", "diagnosis", "account", "supervisor", "run_folder", "schema", "credentials", "wiring", "limits"],
    ["recovery"],
    ["launcher"],
    ["api", "console", "generate", "replay", "deploy"],
    ["cli"],
]
OUTSIDE = {  # what a room may import from outside the standard library
    "observers": {"numpy"},
    "geometry": {"numpy", "scipy"},
    "mesh": {"numpy", "zenoh", "msgpack"},
    "dynamics": {"numpy"},
    "faults": set(),
    "tape": {"numpy", "msgpack"},
    "node": {"numpy"},
    "scenario": {"numpy", "pydantic", "pydantic_core", "ruamel"},
}
ONLY = {
    "zenoh": {"mesh"},
    "rerun": {"report"},
    "cvxpy": {"synthesis"},
    "pydantic": {"scenario", "synthesis", "schema"},
    "cryptography": {"credentials"},
}


def room(path_or_module: str) -> str:
    return path_or_module.removeprefix("duio_mesh.").split(".")[0]


def is_file(module: str) -> bool:
    path = ROOT.joinpath(*module.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def imports() -> Iterator[tuple[str, str, bool]]:
    """(file, imported module, whether it is imported at the top) of every file of the package."""
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        guarded = {
            id(child)
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
            for child in ast.walk(node)
        }
        for node in ast.walk(tree):
            if id(node) in guarded:
                continue
            top = node in tree.body
            if isinstance(node, ast.Import):
                yield from ((name, alias.name, top) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{name}: relative import"
                for alias in node.names:  # a name may be a file of the package, or something in it
                    inner = f"{node.module}.{alias.name}"
                    yield name, inner if is_file(inner) else str(node.module), top


def test_imports_point_down_only() -> None:
    floor = {r: n for n, rooms in enumerate(FLOORS) for r in rooms}
    wrong = []
    for file, module, _ in imports():
        if file == "duio_mesh" or not module.startswith("duio_mesh.") or module == "duio_mesh":
            continue
        here, there = room(file), room(module)
        assert here in floor, f"{file} is on no floor"
        if floor[there] > floor[here]:
            wrong.append(f"{file} imports {module}")
    assert not wrong


def test_no_two_files_import_each_other() -> None:
    pairs = {(file, module) for file, module, _ in imports() if module.startswith("duio_mesh")}
    assert not {(a, b) for a, b in pairs if (b, a) in pairs and a != b}


def test_every_room_keeps_to_its_libraries() -> None:
    wrong = []
    for file, module, _ in imports():
        library = module.split(".")[0]
        if library in sys.stdlib_module_names or library == "duio_mesh":
            continue
        here = room(file)
        if here in OUTSIDE and library not in OUTSIDE[here]:
            wrong.append(f"{file} imports {module}")
        if library in ONLY and here not in ONLY[library]:
            wrong.append(f"{file} imports {module}")
    assert not wrong


def test_synthesis_and_mesh_do_not_know_each_other() -> None:
    for file, module, _ in imports():
        assert not (room(file) == "synthesis" and room(module) == "mesh"), file
        assert not (room(file) == "mesh" and room(module) in ("synthesis", "observers", "scenario")), file
        assert not (file == "duio_mesh.simulation" and room(module) == "mesh"), file


@pytest.mark.parametrize("module", ["duio_mesh.node", "duio_mesh.nursery"])
def test_a_node_has_loaded_numpy_zenoh_and_msgpack_only(module: str) -> None:
    """It cannot redo the global design, and it is small."""
    code = (
        f"import {module}, sys\n"
        "from duio_mesh.methods import METHODS\n"
        "import importlib\n"
        "for m in METHODS: importlib.import_module(f'duio_mesh.observers.{m}')\n"
        "print(*{m.split('.')[0] for m in sys.modules})"
    )
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    allowed = {"duio_mesh", "numpy", "zenoh", "msgpack", "setproctitle", "cython_runtime"}
    foreign = {m for m in loaded - set(sys.stdlib_module_names) - allowed if not m.startswith("_")}
    assert not foreign
    assert {"numpy", "zenoh", "msgpack"} <= loaded


def test_the_launcher_opens_no_zenoh_session() -> None:
    code = "import duio_mesh.cli, duio_mesh.console, duio_mesh.launcher, sys; sys.exit('zenoh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_every_method_has_all_its_parts() -> None:
    from duio_mesh.methods import METHODS

    for method in METHODS:
        for part in (
            f"duio_mesh/synthesis/{method}.py",
            f"duio_mesh/observers/{method}.py",
            f"docs/observers/{method}.md",
        ):
            assert (ROOT / part).exists(), part
        assert any(f"method: {method}\n" in t.read_text() for t in (ROOT / "topologies").glob("*.yaml")), method
