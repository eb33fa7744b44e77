"""Runs every command of every page as a reader does. `make docs-test`; for one page, -k NAME.

`make test` does not collect this file. It parses all commands and runs the quick ones. `tests.docs.pages` describes how
a page marks commands that cannot be run here.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.docs.pages import PAGES, Block, blocks, is_run_here, lay_out, with_interpreter
from tests.helpers.paths import ROOT

PATIENCE_S = 900.0


def environment(folder: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT), "HOME": str(folder), "MPLBACKEND": "agg", "COLUMNS": "100"}


@contextmanager
def ended_with_the_page() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Processes of a page's background commands. They are interrupted at the end of the page."""
    running: list[subprocess.Popen[bytes]] = []
    try:
        yield running
    finally:
        for process in reversed(running):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(60)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page.exists()], ids=lambda page: str(page.relative_to(ROOT))
)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lay_out(page, tmp_path)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "page"}
    with ended_with_the_page() as running:
        for block in blocks(page):
            if block.skipped:
                continue
            if block.language == "python" and block.marks[:1] == ("run",):
                sys.path.insert(0, str(tmp_path))
                exec(compile(block.text, block.where, "exec"), names)
            for words in block.commands():
                if is_run_here(words):
                    run(block, with_interpreter(words, sys.executable), tmp_path, running)


def run(block: Block, words: list[str], folder: Path, running: list[subprocess.Popen[bytes]]) -> None:
    sys.stderr.write(f"\n{block.where}$ {shlex.join(words)}\n")
    process = subprocess.Popen(words, cwd=folder, env=environment(folder), start_new_session=True)
    running.append(process)
    if block.seconds_in_background is not None:
        time.sleep(block.seconds_in_background)
        assert process.poll() is None, f"{block.where}: ended with {process.returncode}"
        return
    assert process.wait(PATIENCE_S) == block.exit_code, block.where
