"""The three ways in which a run can be refused or lost, one per exit code of the command line."""

from __future__ import annotations

from collections.abc import Sequence

STOPPED = 143  # exit code of a process that was asked to stop by SIGTERM


class DuioError(Exception):
    """Anything that duio_mesh itself refuses or reports; the text is meant for the user."""


class ScenarioError(DuioError):
    """The topology file is wrong (exit 2). ``problems`` has one line per problem, each with file:line:column."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


class DesignError(DuioError):
    """The file is well formed but the theory says no (exit 2): the message names condition, node and number."""


class RunError(DuioError):
    """A run that started has failed (exit 3): the message names the process, or the edge, step and round.

    ``lost``: processes whose own end was the cause, and may say more. ``warnings``: what went wrong before.
    """

    def __init__(self, text: str, lost: Sequence[str] = (), warnings: Sequence[str] = ()) -> None:
        super().__init__(text)
        self.lost, self.warnings = tuple(lost), tuple(warnings)
