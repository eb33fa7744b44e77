"""Figures that a command writes into a document, between two lines that say which command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


class DocumentError(Exception):
    """The document cannot take the figures; the text says why and what to do."""


@dataclass(frozen=True)
class Marks:
    """The two lines; what stands outside them is left alone."""

    begin: str
    end: str

    @classmethod
    def of(cls, name: str, command: str) -> Marks:
        """Those of a table called `name` that `command` writes."""
        return cls(f"<!-- {name}: begin, written by `{command}` -->", f"<!-- {name}: end -->")

    def check(self, document: Path | None) -> None:
        """Raises `DocumentError` unless `document` is None or has both lines, in order: before anything is measured."""
        if document is not None:
            self._around(document)

    def put(self, document: Path | None, text: str) -> None:
        """Replace what stands between the lines; None: nowhere.

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
