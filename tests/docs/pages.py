"""The code blocks of the documents, and the commands in them.

A block contains commands if its language is `sh`, or if it has no language and its first command is in `COMMANDS`. A
comment in the line above a block gives it options:

    <!-- docs-test: skip REASON -->      not run here: another machine, Docker, many minutes
    <!-- docs-test: background 8 -->     runs in the background, with 8 s until the next command; ends with the page
    <!-- docs-test: exit 1 -->           expected exit code
    <!-- docs-test: ci -->               `make test` runs it too; each command takes a second or two
    <!-- docs-test: file gru.py -->      a file; a first line `# gru.py` has the same effect
    <!-- docs-test: run -->              Python that is run, in the namespace of its page
    <!-- docs-test: with ORACLE=dnn -->  replaces a placeholder; may be added to the other options
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.helpers.paths import ROOT

PAGES = sorted(
    [
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "examples").rglob("*.md"),
    ]
)
COMMANDS = ("tandem", "python", "pip", "make", "docker", "git", "scp", "sudo", "cd", ".venv/bin/tandem")
PLACEHOLDERS = {"ORACLE": "linear", "DIR": "out", "GROUP": "episodes", "SEED": "0", "S": "0", "N": "40"}
_MARKS = r"(?:<!-- docs-test: (?P<marks>.*?) -->\n+ *)?"
_BLOCK = re.compile(
    rf"^(?P<indent> *){_MARKS}```(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=indent)```",
    re.DOTALL | re.MULTILINE,
)


@dataclass(frozen=True)
class Block:
    """One code block of a page."""

    page: Path
    line: int
    language: str
    text: str
    marks: tuple[str, ...] = ()
    placeholders: dict[str, str] = field(default_factory=dict)

    @property
    def where(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def file(self) -> str | None:
        """Name of the file that the block contains; None if it is not a file."""
        if self.marks[:1] == ("file",):
            return self.marks[1]
        named = re.match(r"# ([\w-]+\.(?:py|toml|csv))\n", self.text)
        return named[1] if named else None

    @property
    def skipped(self) -> bool:
        return self.marks[:1] == ("skip",)

    @property
    def exit_code(self) -> int:
        return int(self.marks[1]) if self.marks[:1] == ("exit",) else 0

    @property
    def seconds_in_background(self) -> float | None:
        """Seconds until the next command of a background command; None for one in the foreground."""
        return float(self.marks[1]) if self.marks[:1] == ("background",) else None

    def commands(self) -> list[list[str]]:
        """Return the words of every command, without comments, prompts and leading environment variables."""
        if self.language not in ("", "sh", "bash", "console") or self.file:
            return []
        joined = re.sub(r"\\\n\s*", " ", self.text)
        lines = [self._words(line.strip().removeprefix("$ ")) for line in joined.splitlines()]
        found = [words for words in lines if words]
        if self.language == "" and not (found and found[0][0] in COMMANDS):
            return []
        return found

    def _words(self, line: str) -> list[str]:
        try:
            words = shlex.split(line, comments=True)
        except ValueError:  # an output with one quotation mark
            return []
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
            del words[0]
        known = PLACEHOLDERS | self.placeholders
        pattern = re.compile(rf"(?<![\w.-])({'|'.join(known)})(?![\w-])")
        return [pattern.sub(lambda match: known[match[0]], word) for word in words]


def blocks(page: Path) -> Iterator[Block]:
    """Return all code blocks of a page, from top to bottom."""
    text = page.read_text(encoding="utf-8")
    for match in _BLOCK.finditer(text):
        marks, _, given = (match["marks"] or "").partition("with ")
        inside = re.sub(rf"^{match['indent']}", "", match["text"], flags=re.MULTILINE)
        yield Block(
            page,
            text.count("\n", 0, match.start("text")),
            match["language"],
            inside,
            tuple(marks.split()),
            dict(pair.split("=", 1) for pair in shlex.split(given)),
        )


def lay_out(page: Path, folder: Path) -> None:
    """Fill a folder as a reader of this page has it: the repository's examples and the files that pages define."""
    for name in ("examples", "configs", "benchmarks", "verification"):
        (folder / name).symlink_to(ROOT / name)
    if page.is_relative_to(ROOT / "examples"):
        for neighbour in page.parent.iterdir():
            if neighbour.suffix != ".md" and not (folder / neighbour.name).exists():
                (folder / neighbour.name).symlink_to(neighbour)
    # A page may use the file of another page; its own files are written last.
    for other in [*(one for one in PAGES if one != page), page]:
        for block in blocks(other) if other.exists() else ():
            if block.file and (other == page or block.text.startswith(f"# {block.file}")):
                (folder / block.file).unlink(missing_ok=True)
                (folder / block.file).write_text(block.text, encoding="utf-8")


def with_interpreter(words: list[str], python: str) -> list[str]:
    """Return the command with this Python and its `tandem`."""
    first = words[0].removeprefix(".venv/bin/")
    if first == "tandem":
        return [python, "-m", "tandem", *words[1:]]
    return [python, *words[1:]] if first == "python" else words


def is_run_here(words: list[str]) -> bool:
    """Whether a command can run in a separate folder, within minutes and without an installation."""
    first = words[0].removeprefix(".venv/bin/")
    measured = words[1:2] == ["-m"] and words[2].split(".")[0] in ("benchmarks", "verification", "mkdocs")
    return (
        first in ("tandem", "python", "cat", "ls", "cd") and not measured and shutil.which("bash") is not None
    )
