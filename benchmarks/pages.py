"""Pages of which some blocks are written anew by a program, between two markers, and the words around them stay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from service.errors import TandemError
from service.io.files import os_errors, write_atomic

NOTHING = "Not recorded yet."


@dataclass(frozen=True, slots=True)
class Page:
    """A page that has to be there already.

    Args:
        path: of the Markdown file.
        program: that writes its blocks, for those who read the source.
    """

    path: Path
    program: str

    def begin(self, block: str) -> str:
        """The marker above a block."""
        return f"<!-- {block}: begin, written by {self.program} -->"

    def end(self, block: str) -> str:
        """The marker below a block."""
        return f"<!-- {block}: end -->"

    def rewrite(self, blocks: Mapping[str, str]) -> None:
        """Write the text of every block anew; an empty one says that nothing is recorded yet.

        Raises:
            TandemError: the page cannot be read or written, or lacks a marker; it is then as it was.
        """
        with os_errors("read", self.path):
            page = self.path.read_text(encoding="utf-8")
        for block, text in blocks.items():
            page = self._replace(page, block, text)
        with os_errors("write", self.path):
            write_atomic(self.path, page.encode())

    def _replace(self, page: str, block: str, text: str) -> str:
        before, found, rest = page.partition(self.begin(block))
        _, found_end, after = rest.partition(self.end(block))
        if not found or not found_end:
            raise TandemError(
                f"{self.path}: no markers for {block}: it needs a line {self.begin(block)} and a line {self.end(block)}"
            )
        return f"{before}{found}\n\n{text or NOTHING}\n\n{found_end}{after}"
