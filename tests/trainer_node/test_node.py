"""The trainer on a real bus, with a controller that consists only of its messages: join, restart, loss, follow."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from network_model.description import hash_layers
from node_runtime.config.sections import Config
from tests.trainer_node.partner import DESCRIPTION, Controller, RunningTrainer, holds, joined
from trainer_node import node as trainer_module

pytestmark = pytest.mark.live


def test_it_trains_and_the_controller_adopts_repeatedly(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(lambda h: h.counters.get("adopted", 0) >= 3, tick=True)
        first, second = controller.adopted[:2]
        assert (first.for_run, first.seq) == ("controller-1", 1)
        assert second.base_sha256 == first.sha256
        assert second.trained_on > first.trained_on
        assert second.loss_after < second.loss_before
        controller.until(holds(controller.seq + 1))
        assert trainer.labels() == list(range(controller.seq + 1))


def test_a_late_trainer_gets_each_missed_sample_once(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        for _ in range(60):
            controller.tick(20)
        with RunningTrainer(config) as trainer:
            # Live samples keep arriving while the old ones are fetched.
            controller.until(joined, tick=True)
            controller.until(holds(controller.seq + 1))
            assert trainer.labels() == list(range(controller.seq + 1))


def test_a_trainer_can_start_before_the_controller_and_the_first_tick(config: Config) -> None:
    with RunningTrainer(config) as trainer, Controller(config, "controller-1") as controller:
        controller.until(joined)
        controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        controller.until(holds(controller.seq + 1))
        assert trainer.labels() == list(range(controller.seq + 1))


def test_a_restarted_trainer_continues_with_rising_versions(config: Config) -> None:
    with Controller(config, "controller-1") as controller:
        with RunningTrainer(config):
            controller.until(lambda h: h.counters["adopted"] >= 2, tick=True)
        reached = controller.version
        with RunningTrainer(config, "trainer-2") as trainer:
            controller.until(lambda h: h.counters.get("adopted", 0) >= 1, tick=True, ignored="trainer-1")
            assert controller.adopted[-1].run_id == "trainer-2"
            assert controller.adopted[-1].seq > reached
            health = controller.until(holds(controller.seq + 1), ignored="trainer-1")
            assert health.counters["not_adopted"] == 0
            assert trainer.labels() == list(range(controller.seq + 1))


def test_lost_samples_are_fetched_and_missed_ticks_are_queried_once(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(joined)
        controller.tick(10)
        controller.until(holds(10))
        asked = len(controller.questions)
        controller.tick(10, lost=True)
        controller.tick(10)
        health = controller.until(holds(30))
        assert health.counters["gaps_filled"] >= 1
        assert trainer.labels() == list(range(30))
        assert len(controller.questions) == asked + 1
        # Skipped ticks look the same. The answer to their query settles them, and there is at most one query a second.
        for _ in range(5):
            controller.tick(1, miss=2)
            controller.tick(1, miss=2)
        controller.until(holds(40))
        # Queries are stamped on arrival; one per gap would make them a tick apart.
        assert np.diff(controller.questions).min() > 0.5 * trainer_module.REFILL_EVERY
        expected = [*range(30), *(29 + 3 * made for made in range(1, 11))]
        assert trainer.labels() == expected


def test_a_restarted_controller_is_followed_and_earlier_samples_are_kept(config: Config) -> None:
    with RunningTrainer(config) as trainer:
        with Controller(config, "controller-1") as controller:
            controller.until(lambda h: h.counters["adopted"] >= 2, tick=True)
            controller.until(holds(controller.seq + 1))
            before, version = controller.seq + 1, controller.version
        with Controller(config, "controller-2", seed=1) as controller:
            joins = controller.until(joined).counters["joined"]
            base = hash_layers(controller.hidden)
            controller.until(lambda h: h.counters["joined"] > joins and h.counters["adopted"] >= 3, tick=True)
            assert controller.adopted[0].for_run == "controller-2"
            assert controller.adopted[0].base_sha256 == base
            assert controller.adopted[0].seq > version
            controller.until(holds(before + controller.seq + 1))
            assert trainer.labels() == sorted([*range(before), *range(controller.seq + 1)])


def test_another_network_starts_with_an_empty_buffer(config: Config) -> None:
    other = msgspec.structs.replace(DESCRIPTION, states=3, input_scale=[1.0] * 4, output_scale=[0.01] * 3)
    with RunningTrainer(config) as trainer:
        with Controller(config, "controller-1") as controller:
            controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
            version = controller.version
        with Controller(config, "controller-2", description=other) as controller:
            controller.until(lambda h: bool(controller.adopted), tick=True)
            assert controller.adopted[0].seq > version
            assert trainer.node.trainer is not None
            assert trainer.node.trainer.description == other
