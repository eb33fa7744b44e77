"""A short log that several test files read."""

from __future__ import annotations

from pathlib import Path

import pytest

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from tests.run_log.samples import STEPS, Logged, synthetic, write


@pytest.fixture(scope="module")
def config() -> Config:
    # Small chunks, so that a short log has many.
    return override(Config(), ["log.chunk_bytes=8192", "controller.keyframe_every=20", "seed=7"])


@pytest.fixture(scope="module")
def messages(config: Config) -> list[Logged]:
    return synthetic(config, STEPS)[1]


@pytest.fixture(scope="module")
def whole(config: Config, messages: list[Logged], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("log") / "run.mcap", config, messages)
