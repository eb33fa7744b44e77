"""Refusals, rollbacks and foreign sets; training continues from the weights in use."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from network_model.description import hash_layers, initial_hidden
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config
from protocol import topics
from protocol.messages import Array, Health
from tests.trainer_node.partner import DESCRIPTION, PATIENCE, Controller, RunningTrainer
from trainer_node import node as trainer_module

pytestmark = pytest.mark.live


def test_a_controller_that_refuses_is_queried_for_its_weights(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        controller.adopts = False
        controller.until(lambda h: h.counters["not_adopted"] >= 1, tick=True)
        base = hash_layers(controller.hidden)
        controller.adopts = True
        controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        assert controller.adopted[0].base_sha256 == base
        assert controller.adopted[0].seq >= 2


def test_after_a_refusal_training_continues_from_the_weights_in_use(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        for refused in range(1, 4):
            controller.adopts = False
            controller.until(lambda h, n=refused: h.counters["not_adopted"] >= n, tick=True)
            controller.adopts = True
            done = len(controller.adopted)
            health = controller.until(lambda _, n=done: len(controller.adopted) > n, tick=True)
        bases = [hash_layers(initial_hidden(DESCRIPTION, np.random.default_rng(0)))]
        bases += [weights.sha256 for weights in controller.adopted]
        assert [weights.base_sha256 for weights in controller.adopted] == bases[:-1]
        # No version was skipped, and no other trainer was assumed.
        assert controller.heard <= health.counters["published"] + 1
        assert health.counters["others_sets"] == 0


@pytest.mark.parametrize("joined_before", [True, False], ids=["its own", "from before it joined"])
def test_after_a_rollback_training_continues_with_the_next_version(
    config: Config, monkeypatch: pytest.MonkeyPatch, joined_before: bool
) -> None:
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", 2 * PATIENCE)
    with Controller(config, "controller-1") as controller, RunningTrainer(config):
        first = controller.hidden
        controller.until(lambda _: len(controller.adopted) >= 2, tick=True)
        controller.until(lambda h: h.counters["adopted"] >= len(controller.adopted), tick=True)
        before = [layer.numpy().astype(float) for layer in controller.adopted[-2].layers]
        # Sets that this trainer may never have seen are recognised by the controller's last decision.
        controller.roll_back(before if joined_before else [1.01 * layer for layer in first])
        back, newest = controller.snapshot().hidden_sha256, controller.version
        controller.until(lambda _: controller.version > newest, tick=True)
        assert controller.adopted[-1].seq == newest + 1
        assert controller.adopted[-1].base_sha256 == back
        health = controller.until(lambda h: h.counters["rolled_back"] >= 1)
        assert (health.counters["others_sets"], health.counters["not_adopted"]) == (0, 0)


@pytest.mark.parametrize(
    ("patience", "lead", "judged"),
    [(2 * PATIENCE, 0, True), (2 * PATIENCE, 400, True), (0.3, 400, False)],
    ids=["adopted", "refused", "heard"],
)
def test_a_trainer_with_a_stolen_name_does_not_block_the_real_one(
    config: Config, monkeypatch: pytest.MonkeyPatch, patience: float, lead: int, judged: bool
) -> None:
    """Foreign sets are decided on, which shows at once, or only received, and then versions must exceed them."""
    monkeypatch.setattr(trainer_module, "ADOPTION_PATIENCE", patience)
    patient = msgspec.structs.replace(
        config, bus=msgspec.structs.replace(config.bus, follow_silence=2 * PATIENCE)
    )
    rng = np.random.default_rng(3)
    with (
        Controller(patient, "controller-1") as controller,
        RunningTrainer(config, "trainer-1"),
        Bus(config, "monitor", "thief") as thief,
    ):
        forged: list[str] = []

        def steal(lead: int) -> None:
            layers = [layer + 0.1 * rng.standard_normal(layer.shape) for layer in controller.hidden]
            packed = [Array.of(layer, "<f4") for layer in layers]
            forged.append(hash_layers([array.numpy() for array in packed]))
            weights = msgspec.structs.replace(
                controller.adopted[-1],
                seq=controller.adopted[-1].seq + lead,
                sha256=forged[-1],
                layers=packed,
            )
            thief.publish(topics.HIDDEN_WEIGHTS, weights)

        def in_use() -> str:
            return controller.adopted[-1].sha256 if controller.adopted else ""

        def stolen(_: Health) -> bool:
            # Repeat it, because the trainer's own sets meanwhile have higher versions.
            if in_use() not in forged:
                steal(5)
            return in_use() in forged

        for _ in range(3):
            controller.until(lambda _: in_use() not in ("", *forged), tick=True)
            controller.until(stolen, tick=True)
            if lead:
                controller.adopts, controller.judges = False, judged
                steal(lead)
                controller.until(lambda _: controller.heard >= controller.adopted[-1].seq + lead, tick=True)
                controller.adopts = controller.judges = True
        controller.until(lambda _: in_use() not in forged, tick=True)
