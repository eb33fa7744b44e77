"""The scale of the network follows the plant's time scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.build import build_model, build_network_oracle
from lbmpc.plants import PLANTS
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from node_runtime.config.loading import load
from node_runtime.config.sections import Config

SLOWER = 64.0


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> Config:
    """Return the compressor with time slowed down by a factor of 64."""
    plant = replace(
        MOORE_GREITZER,
        name="slow",
        rhs=lambda x, u: [slope / SLOWER for slope in MOORE_GREITZER.rhs(x, u)],
        poles=tuple(pole / SLOWER for pole in MOORE_GREITZER.poles or ()),
        W=MOORE_GREITZER.W / SLOWER,
        parameters={},
        equations=None,
    )
    monkeypatch.setitem(PLANTS, "slow", plant)
    return load(None, ["plant.model=slow", f"rate={20 / SLOWER}"])


def test_a_slower_plant_at_the_same_relative_rate_gets_the_same_network(slow: Config) -> None:
    quick, other = build_model(Config()), build_model(slow)
    assert (quick.time_scale, other.time_scale) == (1.0, SLOWER)
    own, same = build_network_oracle(Config(), quick), build_network_oracle(slow, other)
    assert own.description == same.description
    assert np.array_equal(own.bounds, same.bounds)
    assert np.array_equal(own.initial_scale, same.initial_scale)


def test_a_plant_with_a_low_sampling_rate_starts_with_a_small_network(slow: Config) -> None:
    seldom = load(None, ["plant.model=slow", "rate=0.078125", "controller.horizon=10"])
    oracle = build_network_oracle(seldom, build_model(seldom))
    assert np.array_equal(oracle.initial_scale, 1.2e-2 * 0.05 * MOORE_GREITZER.x_scale)
    assert oracle.description is not None
    assert oracle.description.output_scale == (0.4 * 0.2 * MOORE_GREITZER.x_scale).tolist()
