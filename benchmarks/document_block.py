"""Blocks of a document that a command writes, between two marks that name the command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


class DocumentError(Exception):
    """The document cannot take the block; the text says why and what to do."""


@dataclass(frozen=True)
class Marks:
    """The two marks; text outside them does not change."""

    begin: str
    end: str

    @classmethod
    def of(cls, name: str, command: str) -> Marks:
        """Return the marks of a table called `name` that `command` writes."""
        return cls(f"<!-- {name}: begin, written by `{command}` -->", f"<!-- {name}: end -->")

    def check(self, document: Path | None) -> None:
        """Raise `DocumentError` unless `document` is None or has both marks, in order. Call it before measuring."""
        if document is not None:
            self._around(document)

    def put(self, document: Path | None, text: str) -> None:
        """Replace the text between the marks; None: do nothing.

        Raises:
            DocumentError: no such file, or it lacks the lines.
        """
        if document is not None:
            before, after = self._around(document)
            document.write_text(f"{before}{self.begin}\n\n{text}\n\n{self.end}{after}", encoding="utf-8")

    def _around(self, document: Path) -> tuple[str, str]:
        try:
            text = document.read_text(encoding="utf-8")
        except OSError as error:
            raise DocumentError(f"{document}: cannot be read: {error.strerror}") from error
        before, begin, rest = text.partition(self.begin)
        _, end, after = rest.partition(self.end)
        if not begin or not end:
            raise DocumentError(
                f"{document}: the figures go between two lines that it lacks: {self.begin} and {self.end}"
            )
        return before, after
