"""The text below the fields of a class, as the sources have it."""

from __future__ import annotations

import ast
import html
import inspect
import re
import textwrap
from functools import cache


@cache
def field_docs(owner: type) -> dict[str, str]:
    """Return what the string below each field says, by the field's name; those of base classes too."""
    found: dict[str, str] = {}
    for cls in reversed(owner.__mro__):
        try:
            source = inspect.getsource(cls)
        except (OSError, TypeError):  # built in
            continue
        (definition,) = ast.parse(textwrap.dedent(source)).body
        if not isinstance(definition, ast.ClassDef):
            continue
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
                continue
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                found[field.target.id] = inspect.cleandoc(str(below.value.value))
    return found


def own_doc(cls: type) -> str:
    """Return a class's docstring, "" where it has none of its own."""
    return inspect.cleandoc(cls.__dict__.get("__doc__") or "")


def cell(text: str) -> str:
    """Return text as one cell of a Markdown table; code with a bar in it becomes HTML, as Markdown cannot escape it."""
    parts = re.split(r"(`[^`]*`)", re.sub(r"\s+", " ", text).strip())
    return "".join(_code(part) if part.startswith("`") else part.replace("|", "&#124;") for part in parts)


def _code(span: str) -> str:
    if "|" not in span:
        return span
    return f"<code>{html.escape(span.strip('`')).replace('|', '&#124;')}</code>"


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table; without rows an empty text."""
    if not rows:
        return ""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
