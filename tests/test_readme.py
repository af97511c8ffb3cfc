"""What the README shows must work as it stands there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from duio_mesh import cli
from tests.conftest import ROOT, TOPOLOGIES

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.S | re.M)
    return [text for name, text in fences if name == language]


@pytest.mark.mesh
@pytest.mark.usefixtures("nothing_left")
def test_the_python_example_runs() -> None:
    Path("topologies").symlink_to(TOPOLOGIES)
    (code,) = blocks("python")
    check = "assert result.converged and result.trace.xhat.tobytes() == trace.xhat.tobytes()\n"
    subprocess.run([sys.executable, "-c", code + check], check=True)


def test_the_messages_are_the_real_ones(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = [block for block in blocks("") if "ring.yaml:" in block]
    text = (TOPOLOGIES / "ring.yaml").read_text()
    text = text.replace("[[0, 0, 0, 0, 1, 0, 0, 0, 0]", "[[0, 0, 0, 0, 1, 0, 0, 0]", 1)
    Path("ring.yaml").write_text(text.replace("knows: [hvac2]", "knows: [hvac3]", 1))
    Path("plants").symlink_to(TOPOLOGIES / "plants")
    assert cli.main(["ring.yaml"]) == 2
    assert capsys.readouterr().err == shown


def test_every_command_names_files_and_options_that_exist() -> None:
    commands = [line for block in blocks("sh") for line in block.splitlines() if "launch.py topologies" in line]
    assert len(commands) >= 5
    for line in commands:
        name = re.search(r"topologies/(\S+)", line)
        assert name
        assert (TOPOLOGIES / name[1]).exists(), line
        options = re.findall(r"(?<!\S)--[a-z-]+", line.split("launch.py", 1)[1])
        assert all(option in cli.parser().format_help() for option in options), line


def test_every_link_leads_somewhere() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    for page in pages:
        for target in re.findall(r"\]\(([^)#\s]+)", page.read_text()):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
