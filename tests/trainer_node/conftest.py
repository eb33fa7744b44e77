"""A router of its own for each test."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from node_runtime.config.sections import BusConfig, Config
from node_runtime.router import open_router
from tests.helpers.trainer_partner import TRAINING


@pytest.fixture
def config() -> Iterator[Config]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint=f"tcp/127.0.0.1:{port}", follow_silence=0.2))
    with open_router(config):
        yield config
