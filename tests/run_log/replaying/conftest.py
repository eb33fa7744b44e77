"""The log of one lock-step run for all test files that replay it."""

from __future__ import annotations

from pathlib import Path

import pytest

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.reading.reader import read_run
from run_log.run import Run
from run_log.writing.save import save
from tandem.experiments.simulation.lockstep import simulate
from tests.run_log.replaying.edited import EVERY, STEPS

SETTINGS = [
    "controller.horizon=15",
    f"controller.keyframe_every={EVERY}",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "log.chunk_bytes=16384",
]


@pytest.fixture(scope="session")
def config() -> Config:
    return override(Config(), SETTINGS)


@pytest.fixture(scope="session")
def log(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("replay") / "run.mcap"
    save(simulate(config, STEPS), path)
    return path


@pytest.fixture
def run(log: Path) -> Run:
    return read_run(log)
