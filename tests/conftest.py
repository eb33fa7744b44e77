"""What every test has: a C compiler that does not optimise."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator

import pytest

QUICK = """#!/bin/sh
if [ "$1" = --version ]; then
    echo "$({cc} --version | head -n 1), not optimising"
else
    exec {cc} "$@" -O0
fi
"""
"""Seven times as fast. A version of its own: no kernel that it made is found in the cache by a real run."""


@pytest.fixture(scope="session", autouse=True)
def path_before(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Most tests ask what a controller does, and not how fast: they compile its solver without optimisation.

    Yields:
        The PATH on which the compiler is the machine's own.
    """
    before, cc = os.environ["PATH"], shutil.which("cc") or shutil.which("gcc")
    if cc is not None:
        folder = tmp_path_factory.mktemp("quick")
        (folder / "cc").write_text(QUICK.format(cc=cc))
        (folder / "cc").chmod(0o755)
        os.environ["PATH"] = f"{folder}{os.pathsep}{before}"
    yield before
    os.environ["PATH"] = before


@pytest.fixture
def optimising(path_before: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of the compiled code itself: compiled as in a real run."""
    monkeypatch.setenv("PATH", path_before)
