"""Episodes: the plant starts again at x0, controller and trainer keep their memory."""

from __future__ import annotations

import numpy as np
import pytest

from lbmpc.plants import get_plant
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from protocol import messages as m
from protocol import topics
from run_log.replaying.replay import replay
from run_log.run import Run
from tandem.experiments.simulation.faults import Drift, Faults
from tandem.experiments.simulation.lockstep import follow, simulate

PLANT = get_plant("moore_greitzer")
STEPS, EPISODES = 30, 3
SETTINGS = [
    "controller.solver.compile=never",
    "controller.horizon=15",
    "network.hidden=[6]",
    "trainer.steps=5",
    "controller.keyframe_every=20",
]


def config(*more: str) -> Config:
    return load(None, [*SETTINGS, *more])


@pytest.fixture(scope="module")
def run() -> Run:
    return simulate(config(), STEPS, episodes=EPISODES)


def incarnations(run: Run) -> dict[str, list[m.PlantState]]:
    found: dict[str, list[m.PlantState]] = {}
    for state in run.plant_states:
        found.setdefault(state.run_id, []).append(state)
    return found


def test_each_episode_is_another_plant_from_x0(run: Run) -> None:
    plants = incarnations(run)
    assert len(plants) == EPISODES
    for states in plants.values():
        assert [state.seq for state in states] == list(range(STEPS + 1))
        assert states[0].x == PLANT.x0.tolist()
        assert [state.source for state in states] == ["hold"] + STEPS * ["command"]
    assert [tick.seq for tick in run.ticks] == list(range(STEPS * EPISODES))


def test_no_label_spans_two_plants(run: Run) -> None:
    # The label of a period is known at the tick that ends it: the last period of an episode has none.
    ends = [k for k in range(STEPS * EPISODES) if k % STEPS != STEPS - 1]
    assert [sample.seq for sample in run.samples] == ends
    assert [r.seq for r in run.results if r.h is None] == [0, STEPS, 2 * STEPS]
    h = np.array([r.h for r in run.results if r.h is not None])
    jump = np.abs(PLANT.x0 - PLANT.x_e).max()
    assert np.abs(h).max() < 0.1 * jump


def test_the_memory_is_kept(run: Run) -> None:
    K = {w.seq: w.K.numpy() for w in run.output_weights}
    adopted = {r.seq for r in run.results if r.weights_outcome == "adopted"}
    for start in (STEPS, 2 * STEPS):
        # No label is new at the first tick of an episode.
        assert start not in adopted
        np.testing.assert_array_equal(K[start], K[start - 1])
        assert np.abs(K[start]).max() > 0.0
    trained = [weights.samples for weights in run.hidden_weights]
    assert trained == sorted(trained)
    assert trained[-1] > 2 * (STEPS - 1)


def test_a_run_with_episodes_begins_as_one_without(run: Run) -> None:
    alone = simulate(config(), STEPS)
    for topic in (topics.COMMAND, topics.SAMPLES):
        payloads = [entry.payload for entry in alone.entries(topic)]
        assert [entry.payload for entry in run.entries(topic)][: len(payloads)] == payloads


def test_a_log_with_episodes_replays_byte_for_byte(run: Run) -> None:
    assert replay(run).equal
    assert replay(run, from_tick=STEPS + 15).equal


def test_a_drifted_plant_restarts_with_its_present_parameters() -> None:
    faults = Faults(drift=Drift(to={"slope": 1.4}, at=0.5))
    settings = config("controller.oracle=linear")
    first, second = incarnations(follow(settings, 20, faults, episodes=2).run).values()
    # Both are equal until the plant has moved.
    assert first[0].x == second[0].x
    changed = follow(settings, 20, Faults(drift=Drift(to={"slope": 1.4}, at=0.0)), episodes=1).run
    np.testing.assert_allclose(second[1].x, changed.plant_states[1].x, rtol=0.0, atol=1e-3)
    assert np.abs(np.array(first[1].x) - second[1].x).max() > 1e-4


def test_a_lost_plant_is_reported_with_its_episode() -> None:
    faults = Faults(drift=Drift(to={"z_c": -100.0}, at=1.0))
    outcome = follow(config("controller.oracle=linear"), 20, faults, episodes=3)
    assert outcome.lost is not None
    assert "in episode 2 of 3" in outcome.lost
