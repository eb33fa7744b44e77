"""Blocks of a document that a command writes, between two marks that name the command."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

from node_runtime import provenance

WIDTH = 120


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


def conditions(command: str, *notes: str) -> list[str]:
    """Return the lines above a table: the command that measured it, then the machine and the notes, wrapped."""
    machine = provenance.describe()
    where = f"Measured on {machine['processor']}, {machine['cores']} cores, {machine['system']}."
    return ["```", command, "```", "", *wrapped(" ".join([where, *notes]))]


def wrapped(text: str) -> list[str]:
    """Return a paragraph as lines of at most 120 characters; no word and no option is broken."""
    return wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)
