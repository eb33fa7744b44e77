"""A router for each test that needs one, and trainings on one thread."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from node_runtime.config.sections import BusConfig, Config
from node_runtime.router import open_router
from tests.helpers.live import free_endpoint
from tests.trainer_node.partner import TRAINING
from trainer_node.training import use_one_thread


@pytest.fixture
def config() -> Iterator[Config]:
    config = Config(trainer=TRAINING, bus=BusConfig(endpoint=free_endpoint(), follow_silence=0.2))
    with open_router(config):
        yield config


@pytest.fixture
def one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    use_one_thread()
    yield
    torch.set_num_threads(before)
