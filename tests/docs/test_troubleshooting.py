"""The messages that the troubleshooting page quotes are those that Tandem prints."""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest

from tests.helpers.paths import DOCS, INSTALLED, ROOT

PAGE = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
QUOTED = [
    cell
    for section in PAGE.split("\n## ")[1:]
    if "| message |" in section
    for cell in re.findall(r"^\| (`.*?`[^|]*) \|", section, re.MULTILINE)
]


@cache
def literals() -> str:
    """Return all texts in the sources as printed: adjacent literals joined, fields replaced by {}."""
    said = []
    for package in INSTALLED:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    said.append(node.value)
                elif isinstance(node, ast.JoinedStr):
                    said.append(
                        "".join(
                            str(part.value) if isinstance(part, ast.Constant) else "{}"
                            for part in node.values
                        )
                    )
    return re.sub(r"%\w(?:\.\df)?", "{}", "\n".join(said)).replace("`", "")


@pytest.mark.parametrize("message", QUOTED)
def test_a_quoted_message_is_printed_somewhere(message: str) -> None:
    quoted = re.search(r"`(.*?)`", message)
    assert quoted is not None
    for part in re.split(r"\{\w+\}|\d\S*", quoted[1]):
        assert part.strip() in literals(), part


def test_there_are_messages() -> None:
    assert len(QUOTED) > 20
