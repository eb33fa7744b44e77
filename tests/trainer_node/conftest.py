"""A router of its own for each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from node_runtime.config.sections import BusConfig, Config
from node_runtime.router import open_router
from tests.helpers.live import free_endpoint
from tests.trainer_node.partner import TRAINING


@pytest.fixture
def config() -> Iterator[Config]:
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint=free_endpoint(), follow_silence=0.2))
    with open_router(config):
        yield config
