"""Certified sets of the pendulum, computed once."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from lbmpc.plants import PLANTS
from tandem.cli import main
from tests.helpers.plants.pendulum import PENDULUM
from tests.tandem.commands.pendulum_sets import OPTIONS


@pytest.fixture
def known_pendulum(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANTS, "pendulum", PENDULUM)


@pytest.fixture(scope="session")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache with the regions of the pendulum, created with a umask that lets groups write."""
    home = tmp_path_factory.mktemp("home")
    before = os.umask(0o002)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANTS, "pendulum", PENDULUM)
        patch.setenv("XDG_CACHE_HOME", str(home / "cache"))
        try:
            assert main(["sets", "compute", *OPTIONS, "--out", str(home / "sets.json")]) == 0
        finally:
            os.umask(before)
    return home


@pytest.fixture
def cached(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the cache, with sets.json in the same folder; return the folder of the test."""
    shutil.copytree(home / "cache", tmp_path / "cache")
    shutil.copy(home / "sets.json", tmp_path / "sets.json")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path
