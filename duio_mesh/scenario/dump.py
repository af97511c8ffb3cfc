"""A Scenario -> the text of ``scenario.yaml`` in the run folder, which loads again to the same Scenario."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import SafeRepresenter

from duio_mesh.scenario.model import Scenario
from duio_mesh.scenario.source import plain


class _Representer(SafeRepresenter):
    """Quotes every text that would be read back as something else."""

    def text(self, value: str) -> ScalarNode:
        style = None if isinstance(plain(value), str) else '"'
        return self.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Representer.add_representer(str, _Representer.text)


def scenario_yaml(scenario: Scenario, extra: Mapping[str, Any]) -> str:
    """The resolved topology as YAML; ``extra`` (versions, when, where) goes into comments at the top."""
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = None  # innermost lists on one line: a matrix has one row a line
    yaml.width = 2**20
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    out = io.StringIO()
    out.write("# The topology as resolved: plant file and --set arguments included. It can be run again as it is.\n")
    for name, value in extra.items():
        out.write(f"# {name}: {' '.join(str(value).split())}\n")
    yaml.dump(scenario.document, out)
    return out.getvalue()
