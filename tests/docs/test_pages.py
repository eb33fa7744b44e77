"""Every path, command, option and module that the pages and the sources name exists."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

from docs.generators.generated import GENERATED
from tandem.cli import main
from tests.helpers.paths import INSTALLED, ROOT

PACKAGES = (*INSTALLED, "benchmarks", "verification", "examples", "tests")
GENERATED_PAGES = {ROOT / "docs" / uri for uri in GENERATED}
NAMED = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md")
PAGES = sorted(
    [*(ROOT / name for name in NAMED), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")]
)
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
NAME = "|".join(PACKAGES)
PATH = re.compile(rf"(?<![\w/.<-])((?:{NAME}|configs|docs|docker)/[\w./-]*\w/?)(?![\w*<])")
FILE = re.compile(r"`([\w-]+\.py)`")
LINK = re.compile(r"\]\((?!https?:)([^)#\s]+)[^)]*\)")
MODULE = re.compile(rf"`((?:{NAME})(?:\.\w+)+)")
RUN = re.compile(r"python -m ([\w.]+)")
MAKE = re.compile(r"\bmake ([a-z-]+)\b(?=[`\s\"])")
TANDEM = re.compile(r"(?:^|[`\s/])tandem ((?:[a-z]+(?:-[a-z]+)* ?){1,2})([^`\n|]*)", re.MULTILINE)
# Paths that a page may name because a run creates them, or because they are examples of a reader's files.
MADE = ("tandem/jet",)
METADATA = {"tandem.configuration"}
"""Keys of an exported file. They look like modules."""
OWN = {"gru.py", "tanks.py", "tank.py", "true.py", "my.py"}


def code(text: str) -> str:
    """Return inline code and code blocks of a page, one per line."""
    blocks = re.findall(r"^```.*?^```", text, re.DOTALL | re.MULTILINE)
    return "\n".join([*blocks, *re.findall(r"`[^`\n]+`", text)])


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


@cache
def source(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def is_a_module(dotted: str) -> bool:
    """Whether a dotted name is a package, a module, or a name in a module."""
    parts = dotted.split(".")
    for length in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:length])
        rest = parts[length:]
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return not rest or re.search(rf"\b{rest[0]}\b", source(file)) is not None
    return False


@cache
def help_of(*words: str) -> str | None:
    """Return the output of `tandem WORDS --help`; None if there is no such command."""
    import contextlib
    import io

    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        return said.getvalue() if main([*words, "--help"]) == 0 else None


def leads_somewhere(page: Path, link: str) -> bool:
    """Whether a link leads to a file, or to a page that the site generates from the code."""
    target = (page.parent / link).resolve()
    return target.exists() or target in GENERATED_PAGES


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_paths_and_links_of_a_page_exist(page: Path) -> None:
    text = source(page)
    named = {path for path in PATH.findall(code(text)) if not path.startswith(MADE)}
    missing = {path for path in named if not (ROOT / path).exists()}
    missing |= {link for link in LINK.findall(text) if not leads_somewhere(page, link)}
    names = {path.name for path in SOURCES}
    missing |= {name for name in FILE.findall(text) if name not in names | OWN}
    assert missing == set()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_modules_and_targets_of_a_page_exist(page: Path) -> None:
    text = code(source(page))
    wrong = {name for name in set(MODULE.findall(text)) - METADATA if not is_a_module(name)}
    wrong |= {name for name in RUN.findall(text) if name.startswith(PACKAGES) and not is_a_module(name)}
    targets = re.findall(r"^([a-z-]+):", source(ROOT / "Makefile"), re.MULTILINE)
    wrong |= {f"make {name}" for name in MAKE.findall(text) if name not in targets}
    assert wrong == set()


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_commands_and_options_of_a_page_exist(page: Path) -> None:
    wrong = set()
    for words, rest in TANDEM.findall(code(source(page))):
        chosen = words.split()
        told = help_of(*chosen)
        if told is None:
            # The second word is an argument, or part of a sentence.
            chosen = chosen[:1]
            told = help_of(*chosen)
        if told is None:
            wrong.add(f"tandem {words}")
            continue
        for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", rest):
            if option not in told:
                wrong.add(f"tandem {' '.join(chosen)} {option}")
    assert wrong == set()


def test_modules_that_the_sources_name_exist() -> None:
    wrong = {
        f"{relative(path)}: {name}"
        for path in SOURCES
        for name in MODULE.findall(source(path))
        if not is_a_module(name)
    }
    assert wrong == set()


def test_paths_that_the_sources_name_exist() -> None:
    inside = re.compile(rf"`((?:{NAME}|configs|docs)/[\w./-]*\w)")
    wrong = {
        f"{relative(path)}: {name}"
        for path in SOURCES
        for name in inside.findall(source(path))
        if not name.startswith(MADE) and not (ROOT / name).exists()
    }
    assert wrong == set()
