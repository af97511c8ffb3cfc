"""What was run and what the design promises, as markdown: the page in a recording that tells a reader what it shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from duio_mesh.report.losses import node_loss_in_words
from duio_mesh.scenario.model import Scenario

WIDE = 7  # columns of a table that fit a page; further ones go into a second table


def describe(scenario: Scenario, certificate: Mapping[str, Any]) -> str:
    """Markdown: the scenario, its nodes, and the certificate's conditions, per-node figures and other figures."""
    plant, run = scenario.plant, scenario.run
    lines = [
        f"# {scenario.name}",
        scenario.description,
        "",
        f"Method **{scenario.method}**; nodes {len(scenario.nodes)}, states {plant.n}, inputs {plant.B.shape[1]}, "
        f"disturbances {plant.E.shape[1]}. {plant.time.capitalize()} plant, {plant.step:g} s a step, "
        f"{run.steps} steps, seed {run.seed}.",
        "",
        f"Converged means: every node's RMS error per state over the last {run.convergence.over_last:.0%} of the run "
        f"is below {run.convergence.rms_below:g}.",
        "",
        "## Nodes",
        *_table(
            ["node", "measurements", "is told", "hears"],
            [
                [i, node.C.shape[0], ", ".join(node.knows) or "nothing", ", ".join(map(str, scenario.graph.hears(i)))]
                for i, node in scenario.nodes.items()
            ],
        ),
    ]
    certificate = dict(certificate)
    lost = certificate.pop("node_loss", {})
    conditions, nodes = certificate.pop("conditions", {}), certificate.pop("nodes", {})
    if conditions:
        lines += ["", "## Conditions", *_conditions(conditions)]
    if certificate:
        lines += ["", "## Design", *_table(["figure", "value"], [[name, v] for name, v in certificate.items()])]
    if lost:
        lines += ["", node_loss_in_words(lost, run.on_node_loss)]
    if nodes:
        lines += ["", "## Design, by node", *_nodes(nodes)]
    return "\n".join(lines) + "\n"


def needed(condition: Mapping[str, Any]) -> str:
    """What a condition of a certificate asks for, in words: a method without numbers to compare has words itself."""
    threshold = condition.get("threshold", "-")
    return f"{condition['relation']} {threshold:g}" if "relation" in condition else str(threshold)


def _conditions(conditions: Mapping[str, Any]) -> list[str]:
    head = ["condition", "value", "needed", "holds"]
    return _table(head, [[name, c.get("value"), needed(c), c.get("ok")] for name, c in conditions.items()])


def _nodes(nodes: Mapping[Any, Mapping[str, Any]]) -> list[str]:
    """One row per node; as many tables below each other as the columns need."""
    names = list(next(iter(nodes.values())))
    lines: list[str] = []
    for first in range(0, len(names), WIDE):
        part = names[first : first + WIDE]
        lines += [*_table(["node", *part], [[i, *(node.get(name) for name in part)] for i, node in nodes.items()]), ""]
    return lines


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """A markdown table with an empty line before it."""
    body = [[_text(cell) for cell in row] for row in rows]
    return ["", *(f"| {' | '.join(row)} |" for row in [[_text(h) for h in head], ["---"] * len(head), *body])]


def _text(value: Any) -> str:
    """Plain data in one cell."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{_text(k)} {_text(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(_text(v) for v in value)
    return str(value).replace("|", "\\|").replace("\n", " ")
