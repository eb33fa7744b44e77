"""The simulated plant with sensors that err: a process of its own, for `tests.helpers.live.Process`."""

from __future__ import annotations

from unittest import mock

import msgspec
import numpy as np

from node_runtime.config.sections import Config
from plant_sim import node
from plant_sim.simulator import PlantSim
from protocol.messages import PlantState

NOISE = 7e-4
"""Standard deviation of the two states that the paper's plant is judged by; plant units."""


class NoisyPlant(PlantSim):
    """Its motion is the true one; what it says of itself is not."""

    draws = np.random.default_rng(5)

    def sample(self, t: float) -> PlantState:
        true = super().sample(t)
        noise = np.concatenate([NOISE * self.draws.standard_normal(2), np.zeros(self.plant.d - 2)])
        return msgspec.structs.replace(true, x=(np.array(true.x) + noise).tolist())


def main(config: Config) -> int:
    """`tandem plant`, with such sensors."""
    with mock.patch.object(node, "PlantSim", NoisyPlant):
        return node.main(config)
