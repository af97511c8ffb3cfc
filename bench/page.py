"""What a benchmark says, on the screen and between two markers of a page under docs/."""

from __future__ import annotations

from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


class Page:
    """Prints, and puts everything that it printed between `<!-- name -->` and `<!-- end of name -->` of a page."""

    def __init__(self, page: str, name: str) -> None:
        self._page, self._name = DOCS / page, name
        self._lines: list[str] = []

    def say(self, text: str = "") -> None:
        """Print a line, or several."""
        print(text, flush=True)
        self._lines.append(text)

    def write(self) -> None:
        """Replace what the page has there. Raises ValueError where it has no such markers."""
        begin, end = f"<!-- {self._name} -->\n", f"<!-- end of {self._name} -->\n"
        before, rest = self._page.read_text(encoding="utf-8").split(begin)
        _, after = rest.split(end)
        text = "\n".join(self._lines).rstrip("\n")
        self._page.write_text(f"{before}{begin}{text}\n{end}{after}", encoding="utf-8")
