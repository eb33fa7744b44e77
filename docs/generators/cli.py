"""The page of the command line: every command and option, from what `--help` prints."""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from docs.generators.field_docs import cell, table
from tandem.cli import main

HEAD = """# Command line

This page is made from the commands' own `--help`.

Every command has `--help` and `--json`. With `--json` a command prints one JSON object on standard output, and nothing
else there; messages for a person then go to standard error.

| exit code | meaning |
| --- | --- |
| 0 | success |
| 1 | the command ran and failed: a replay differs, a process died, a file could not be written |
| 2 | the command cannot run: a mistake in the arguments, the configuration or a file |
| 3 | there are no certified sets, or their certificate does not hold |
| 130 | interrupted |

"""
COMMON = ("-h", "--json")
"""What every command has, and no table repeats."""


@dataclass
class Help:
    """What `--help` says of one command."""

    usage: str = ""
    text: str = ""
    options: list[tuple[str, str]] = field(default_factory=list)
    """(option or argument with its value's name, meaning)."""
    subcommands: list[str] = field(default_factory=list)


def page() -> str:
    """Return the whole page."""
    return HEAD + "\n".join(_section(words, read) for words, read in commands() if words)


def commands(words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Help]]:
    """Yield every command, a group before its members."""
    read = read_help(printed_help(words))
    yield words, read
    for name in read.subcommands:
        yield from commands((*words, name))


def printed_help(words: tuple[str, ...]) -> str:
    """Return what a command's `--help` prints on a very wide terminal."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "2000"
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # tyro draws its boxes for UTF-8 alone
    try:
        with contextlib.redirect_stdout(printed):
            main([*words, "--help"])
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before
    printed.seek(0)
    return printed.read()


def read_help(printed: str) -> Help:
    """Return what is in a help text of tyro's: usage, description, then boxes of arguments and subcommands."""
    read, box = Help(), ""
    for line in printed.splitlines():
        inside = re.fullmatch(r"│ (.*) │", line)
        if line.startswith("usage: "):
            read.usage = line.removeprefix("usage: ")
        elif line.startswith("╭"):
            box = line.strip("╭─╮ ")
        elif inside and box == "subcommands":
            if named := re.match(r"\s*• (\S+)", inside[1]):
                read.subcommands.append(named[1])
        elif inside:
            _take(read.options, inside[1].rstrip())
        elif not line.startswith("╰"):
            read.text += f"{line} "
    read.text = cell(read.text)
    return read


def _take(options: list[tuple[str, str]], line: str) -> None:
    if line.startswith(" "):
        name, meaning = options.pop()
        options.append((name, f"{meaning} {line.strip()}".strip()))
    else:
        name, _, meaning = line.partition("  ")
        options.append((name, meaning.strip()))


def _section(words: tuple[str, ...], read: Help) -> str:
    name = " ".join(("tandem", *words))
    lines = [f"{'#' * (len(words) + 1)} {name}\n", f"{read.text}\n"]
    if not read.subcommands:
        rows = [_row(name, meaning) for name, meaning in read.options if not name.startswith(COMMON)]
        arguments = [name for name, _ in read.options if not name.startswith("-")]
        lines += [f"```text\n{' '.join([name, *arguments, '[OPTIONS]'])}\n```\n"]
        lines += [table(["argument", "meaning", "default"], rows)]
    return "\n".join(lines)


def _row(name: str, meaning: str) -> list[str]:
    """Return the cells of one argument: a default stands in brackets at the end of its meaning."""
    found = re.fullmatch(r"(?P<text>.*?) ?\((?P<default>default: .*|required|repeatable)\)", meaning)
    text, default = (found["text"], found["default"].removeprefix("default: ")) if found else (meaning, "")
    return [cell(f"`{name}`"), cell(text), cell("off" if default == "False" else default)]
