"""docs/generate.md: its commands work, and every option is on the page."""

from __future__ import annotations

import argparse
import re
import shlex
from pathlib import Path

import pytest

from duio_mesh.cli import main
from duio_mesh.generate.command import parser
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "generate.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("line", re.findall(r"^python launch.py (new .*--out .*)$", PAGE, re.MULTILINE))
def test_the_commands_of_the_page(line: str) -> None:
    words = shlex.split(line)
    assert main(words) == 0
    assert Path(words[-1]).exists()


@pytest.mark.parametrize("order", re.findall(r"^\| `((?:heat|platoon|swing) .*?)` \|", PAGE, re.MULTILINE))
def test_the_systems_of_the_table_exist(order: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["new", *order.split()]) == 0
    limit = re.search(rf"{re.escape(order)}` \|[^|]*\|[^|]*\| (.*) \|", PAGE)
    assert limit is not None
    assert f"rms_below: {limit[1]}," in capsys.readouterr().out


def test_every_option_is_on_the_page_and_has_help() -> None:
    (kinds,) = (a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    for kind, options in kinds.choices.items():
        assert f"## {kind}\n" in PAGE
        for action in options._actions:
            assert action.help
            if action.dest != "help":
                assert action.option_strings[0] in PAGE
        options.format_help()
