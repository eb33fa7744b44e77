"""The simulated plant with sensors that err: a process of its own, for `tests.helpers.live.Process`."""

from __future__ import annotations

from unittest import mock

import numpy as np

from node_runtime.config.sections import Config
from plant_sim import node
from plant_sim.simulator import Motion

NOISE = 7e-4
"""Standard deviation of the two states that the paper's plant is judged by; plant units."""


class NoisyMotion(Motion):
    """It moves as the truth says; what is measured of it is not."""

    draws = np.random.default_rng(5)

    def read(self, due: float) -> np.ndarray:
        x = super().read(due)
        noise = np.concatenate([NOISE * self.draws.standard_normal(2), np.zeros(len(x) - 2)])
        return x + noise


def main(config: Config) -> int:
    """`tandem plant`, with such sensors."""
    with mock.patch.object(node, "Motion", NoisyMotion):
        return node.main(config)
