"""The small experiment as a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tandem.experiments.small import SMALL


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path
