"""Every command of every page is valid: the real parser accepts it, with its keys and files."""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import itertools
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from node_runtime.config.strict import ConfigError
from tandem.cli import parse
from tandem.commands.base import Configured
from tests.docs.pages import PAGES, Block, blocks, lay_out, with_interpreter
from tests.helpers.paths import ROOT

EXISTING = [page for page in PAGES if page.exists()]
NAMED_FILE = re.compile(r"[\w./-]+\.(?:py|toml|mcap|csv|json)(?=$|:)")
WRITTEN = ("--log", "--out", "--output", "--layout")
# Files that a command writes under a default name.
LEFT = {"run": ["run.mcap", "run.png"], "keys": ["keys"], "record": ["run.mcap"]}


def relative(page: Path) -> str:
    return str(page.relative_to(ROOT))


def parsed(block: Block, words: list[str]) -> Configured | None:
    """Parse a command; resolve its configuration if it has one."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            command = parse(words)
    except SystemExit as end:
        if end.code:
            pytest.fail(f"{block.where}: tandem {' '.join(words)}\n{said.getvalue()}")
        return None
    if not isinstance(command, Configured):
        return None
    try:
        command.resolve()
    except ConfigError as error:
        if block.exit_code != 2:
            pytest.fail(f"{block.where}: tandem {' '.join(words)}\n{error}")
    return command


@pytest.mark.parametrize("page", EXISTING, ids=relative)
def test_commands_parse_and_what_they_name_exists(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lay_out(page, tmp_path)
    monkeypatch.chdir(tmp_path)
    made: set[str] = set()
    for block in blocks(page):
        for words in block.commands():
            program, *rest = with_interpreter(words, "python")
            if rest[:2] == ["-m", "tandem"] and rest[2:] != ["--version"]:
                parsed(block, rest[2:])
            made |= made_by(words)
            if block.skipped or program != "python":
                continue
            named = {
                match[0] for word in rest for match in NAMED_FILE.finditer(word.partition("=")[2] or word)
            }
            missing = {name for name in named - made if not (tmp_path / name).exists()}
            assert not missing, f"{block.where}: {' '.join(words)}"


def made_by(words: list[str]) -> set[str]:
    """Create the files that a command would write, for the commands after it."""
    named = {value for option, value in itertools.pairwise(words) if option in WRITTEN}
    new = set(words[3:4]) if words[1:3] == ["model", "new"] else set()
    return named | new | set(LEFT.get(words[1] if words[1:] else "", []))


@pytest.mark.parametrize("page", EXISTING, ids=relative)
def test_python_and_data_of_a_page_are_sound(page: Path) -> None:
    for block in blocks(page):
        if block.skipped:
            continue
        match block.language:
            case "python":
                for node in ast.walk(ast.parse(block.text, block.where)):
                    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                        require_names(block, node)
            case "toml":
                tomllib.loads(block.text)
            case "json":
                json.loads(block.text)


def require_names(block: Block, node: ast.ImportFrom) -> None:
    """Every name that a page imports from Tandem exists."""
    module = node.module or ""
    if not (ROOT / module.partition(".")[0] / "__init__.py").exists():
        return
    imported = importlib.import_module(module)
    missing = [name.name for name in node.names if not hasattr(imported, name.name)]
    assert not missing, f"{block.where}: {module} has no {', '.join(missing)}"


QUICK = [page for page in EXISTING if any(block.marks[:1] == ("ci",) for block in blocks(page))]


@pytest.mark.parametrize("page", QUICK, ids=relative)
def test_quick_commands_of_a_page_run(page: Path, tmp_path: Path) -> None:
    lay_out(page, tmp_path)
    for block in blocks(page):
        for words in block.commands() if block.marks[:1] == ("ci",) else ():
            done = subprocess.run(
                with_interpreter(words, sys.executable),
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=60,
                env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
            )
            assert done.returncode == 0, f"{block.where}: {' '.join(words)}\n{done.stderr}{done.stdout}"
