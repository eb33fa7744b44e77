"""Plain English and short lines: what CONTRIBUTING.md asks of every text, as far as a pattern can see it."""

from __future__ import annotations

import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

LONGEST = 120
KINDS = {".py", ".md", ".toml", ".yml", ".yaml", ".c", ".css", ".j2", ".html", ".js", ".cff", ""}
# Texts of other people, and the patterns themselves.
FOREIGN = re.compile(r"tandem/web/uPlot|(^|/)LICENSE|tests/docs/test_style\.py$")

PATTERNS = {
    r"nobody|somebody|whoever|whomever": "name the person, the process or the role",
    r"of which|of whom|whose are|who has its": "begin a new sentence",
    r"all the same": "still, or nothing",
    r"in the place of": "instead of",
    r"what (?:became|becomes|came) of|what came": "the outcome of, what arrived",
    r"what (?:it|they|that|this|these|those) (?:is|are|was|were) worth|(?:is|are) worth (?:\d|nothing|little|much)": (
        "say the figure"
    ),
    r"carr(?:y|ies) no witness|vouch(?:es|ed)?": "say what is not known",
    r"goes? on alone|hurts? tandem|puts? tandem to the test": "say what the program does",
    r"(?:a|the) (?:dead|lying|honest|silent) (?:router|network|controller|oracle) (?:carries|lies|says)": "no persons",
    r"no hand on|a hand on the switch|a person's word": "the term is manual operation",
    r"for it (?:is|was|does|has|would|may|cannot)": "because it",
    r"neither does it|nor does it|as far as it goes|ever after": "say it plainly",
}
# One expression for all: the files are read once.
_ANY = re.compile(rf"\b(?:{'|'.join(f'({pattern})' for pattern in PATTERNS)})\b")
# A fragment that begins with the possessor: "Of the policy that ..." instead of "The policy that ...".
_FRONTED = re.compile(
    r'(?:"""|^|[.;:] )Of (?:a|an|the|all|everything|each|every|its|those|them)\b[^,.]*', re.MULTILINE
)


@cache
def tracked() -> tuple[str, ...]:
    """Every text file of the repository that people write."""
    names = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=ROOT, capture_output=True, check=True
    ).stdout.decode()
    return tuple(
        name
        for name in names.split("\0")
        if name and Path(name).suffix in KINDS and not FOREIGN.search(name) and (ROOT / name).is_file()
    )


def prose(name: str, text: str) -> str:
    """A page without its code blocks, inline code and quotations, which may show what not to write."""
    if not name.endswith(".md"):
        return text
    without = re.sub(r"^( *)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`\n]+`", "", without)


def long_lines(name: str, text: str) -> list[str]:
    """Return the lines that are too long; Markdown tables, code blocks and targets of links are left out."""
    if name.endswith(".md"):
        text = re.sub(r"^( *)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
        text = re.sub(r"\]\([^)\s]*\)", "]", text)
        lines = [line for line in text.splitlines() if not line.lstrip().startswith("|")]
    else:
        lines = [line for line in text.splitlines() if "https://" not in line]
    return [line for line in lines if len(line) > LONGEST]


def found(name: str) -> list[str]:
    """What is wrong with a file."""
    text = (ROOT / name).read_text(encoding="utf-8")
    said = [f"{len(line)} characters: {line.strip()[:60]}..." for line in long_lines(name, text)]
    said += [
        f"{mark[0]}: a merge that was not finished" for mark in re.finditer("^[<>]{7} ", text, re.MULTILINE)
    ]
    read = prose(name, text)
    why = list(PATTERNS.values())
    said += [
        f"{match[0]!r}: {why[match.lastindex - 1]}"
        for match in _ANY.finditer(read.lower())
        if match.lastindex
    ]
    said += [f"{match[0]!r}: name the thing first" for match in _FRONTED.finditer(read)]
    return said


def test_lines_are_short_and_english_is_plain() -> None:
    wrong = {name: said for name in tracked() if (said := found(name))}
    assert wrong == {}


@pytest.mark.parametrize(
    ("name", "text", "is_wrong"),
    [
        ("a.md", "Nobody knows.\n", True),
        ("a.md", "<" * 7 + " HEAD\n", True),
        ("a.md", "```\nnobody\n```\nThe user `nobody` runs it.\n", False),
        ("a.py", '"""Of the policy that the plant follows."""\n', True),
        ("a.md", "x" * 121 + "\n", True),
        ("a.md", "| " + "x" * 121 + " |\n", False),
        ("a.md", f"[page]({'x' * 121})\n", False),
    ],
)
def test_the_check_finds_what_it_is_for(
    name: str, text: str, is_wrong: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    (tmp_path / name).write_text(text, encoding="utf-8")
    assert bool(found(name)) is is_wrong


if __name__ == "__main__":  # python -m tests.docs.test_style [FILE...]: what is wrong, file by file
    for path in sys.argv[1:] or tracked():
        for text in found(path):
            print(f"{path}: {text}")  # noqa: T201
