"""Transitions between the samples of a log: none spans an episode, a gap or a restart."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from controller_node.build import build_model
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import topics
from run_log.errors import LogError
from run_log.reading.transitions import observed
from run_log.run import Entry, Run
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.pendulum import pendulum

SETTINGS = ["controller.oracle=constant", "controller.solver.compile=never", "trainer.enabled=false"]


@pytest.fixture(scope="module")
def episodes() -> Run:
    return simulate(override(Config(), SETTINGS), 12, episodes=2)


def test_each_transition_is_a_true_step_within_one_episode(episodes: Run) -> None:
    model = build_model(episodes.config)
    seen = observed(episodes, model)
    states = episodes.plant_states
    # After its last tick an episode has one more sample, which the controller does not use.
    pairs = [(a, b) for a, b in pairwise(states) if a.run_id == b.run_id and b.seq < 12]
    assert len(pairs) == 22
    np.testing.assert_allclose(seen.transitions.x, [a.x for a, _b in pairs], atol=1e-13)
    np.testing.assert_allclose(seen.transitions.u, [b.applied for _a, b in pairs], atol=1e-13)
    np.testing.assert_allclose(seen.transitions.after, [b.x for _a, b in pairs], atol=1e-13)
    missed = (
        seen.transitions.after
        - model.plant.x_e
        - np.array(
            [
                model.step(np.array(a.x) - model.plant.x_e, np.array(b.applied) - model.plant.u_e)
                for a, b in pairs
            ]
        )
    )
    np.testing.assert_allclose(seen.missed, missed, atol=1e-13)


def test_a_sample_that_is_logged_twice_counts_once_and_order_is_that_of_time(episodes: Run) -> None:
    model = build_model(episodes.config)
    entries = episodes.entries(topics.SAMPLES)
    again = Run(
        episodes.path,
        episodes.config,
        streams={**episodes.streams, topics.SAMPLES.name: [*entries[::-1], *entries]},
    )
    np.testing.assert_array_equal(
        observed(again, model).transitions.x, observed(episodes, model).transitions.x
    )


def test_samples_of_strangers_are_left_out(episodes: Run) -> None:
    model = build_model(episodes.config)
    first = episodes.entries(topics.SAMPLES)[0]
    foreign = msgspec.structs.replace(first.message, run_id="controller-stranger")
    streams = {
        **episodes.streams,
        topics.SAMPLES.name: [*episodes.entries(topics.SAMPLES), Entry(0, b"", foreign)],
    }
    assert len(observed(Run(episodes.path, episodes.config, streams=streams), model).transitions) == 22


def test_a_log_without_samples_and_one_of_another_plant_are_refused(episodes: Run) -> None:
    with pytest.raises(LogError, match="contains no samples"):
        observed(Run(episodes.path, episodes.config), build_model(episodes.config))
    with pytest.raises(
        LogError, match="do not fit a plant with the states angle, rate and the inputs torque"
    ):
        observed(episodes, pendulum())
