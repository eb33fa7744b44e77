"""The real processes with measurement noise: sets are refused and rolled back, and training continues."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.router import open_router
from protocol import messages as m
from protocol import topics
from tests.helpers.live import BusListener, Process, live_config
from trainer_node.node import ADOPTION_PATIENCE

SETTINGS = (
    "rate=50",
    "controller.horizon=20",
    "controller.solver.compile=never",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "trainer.train_every=5",
    "plant.sensors.noise={z=1.4e-3, y=1.4e-3}",
    "plant.x0=[0.4,1.6,1.1547,0]",
)


@pytest.mark.live
@pytest.mark.long
def test_refusals_and_rollbacks_do_not_delay_training() -> None:
    config = live_config(*SETTINGS)
    with (
        open_router(config),
        Bus(config, "recorder", "recorder-a") as bus,
        Process("trainer_node.main", config),
        Process("plant_sim.node", config),
    ):
        ear = BusListener(bus)
        with Process("controller_node.node", config):
            refused, adopted = 0, 0

            def enough(message: m.Message) -> bool:
                nonlocal refused, adopted
                if isinstance(message, m.TickResult):
                    refused += message.weights_outcome == "refused" or message.weights_rolled_back != ""
                    adopted += message.weights_outcome == "adopted"
                return refused >= 2 and adopted >= 3

            ear.until(enough)
        versions = [weights.seq for weights in ear.of(topics.HIDDEN_WEIGHTS)]
        assert versions == list(range(1, len(versions) + 1))
        ticks = [tick for tick in ear.of(topics.TICK) if tick.weights is not None]
        # Use the median, because other work may take this machine's cores for seconds.
        waits = [(b.slot - a.slot) * config.period for a, b in itertools.pairwise(ticks)]
        assert float(np.median(waits)) < 0.5 * ADOPTION_PATIENCE
