"""Invalid messages to a trainer are counted and stop nothing."""

from __future__ import annotations

import os
import tracemalloc

import msgspec
import numpy as np
import pytest
import zenoh

from network_model.description import LAYERS, hash_layers
from node_runtime.bus.zenoh_bus import session_config
from node_runtime.config.sections import Config
from protocol import topics
from protocol.messages import Array, OutputWeights, Sample, Samples
from tests.trainer_node.partner import Controller, RunningTrainer, holds, joined

pytestmark = pytest.mark.live


def test_bad_messages_are_counted_and_stop_nothing(config: Config) -> None:
    # The foreign sender must not take over, however slow this machine is.
    config = msgspec.structs.replace(config, bus=msgspec.structs.replace(config.bus, follow_silence=60.0))
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        controller.until(joined)
        session = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        for topic in (topics.SAMPLES, topics.OUTPUT_WEIGHTS):
            for payload in (b"", b"\xc1" * 40, os.urandom(200)):
                session.put(topic.key(config.name), payload)
        controller.tick(5)
        nan = Sample(seq=9, x=[float("nan"), 0.0], u=[0.0], h=[0.0, 0.0])
        long = Sample(seq=9, x=[0.0] * 3, u=[0.0], h=[0.0, 0.0])
        foreign = Sample(seq=9, x=[0.0] * 2, u=[0.0], h=[0.0, 0.0])
        for run, sample in (("controller-1", nan), ("someone", foreign), ("controller-1", long)):
            controller.bus.publish(topics.SAMPLES, Samples(run_id=run, seq=5, samples=[sample]))
        controller.bus.publish(
            topics.OUTPUT_WEIGHTS,
            OutputWeights(
                run_id="controller-1",
                seq=5,
                hidden_version=0,
                hidden_sha256=hash_layers(controller.hidden),
                K=Array.of(np.zeros((3, 7))),
            ),
        )
        controller.seq = 5
        health = controller.until(lambda h: h.counters["adopted"] >= 1, tick=True)
        session.close()
        for key in (
            "bad_controller_samples_malformed",
            "bad_controller_output_weights_malformed",
            "bad_controller_samples_not_finite",
            "bad_controller_samples_wrong_size",
            "bad_controller_samples_foreign",
        ):
            assert health.counters.get(key, 0) >= 1, (key, health.counters)
        controller.until(holds(controller.seq))
        assert trainer.labels() == [*range(5), *range(6, controller.seq + 1)]


def test_an_invalid_snapshot_is_not_used(config: Config) -> None:
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        right = controller.hidden
        controller.hidden = [np.full_like(layer, np.inf) for layer in right]
        bad = "bad_controller_hidden_not_finite"
        controller.until(lambda h: h.counters.get(bad, 0) >= 1)
        controller.hidden = right[::-1] * 2
        bad = "bad_controller_hidden_unusable"
        before = controller.until(lambda h: h.counters.get(bad, 0) >= 1).counters[bad]
        controller.hidden, controller.claimed = right, "0" * 64
        controller.until(lambda h: h.counters[bad] >= before + 2)
        assert trainer.node.trainer is None
        controller.claimed = ""
        controller.until(joined)


def test_a_huge_network_allocates_no_memory(config: Config) -> None:
    """A stolen controller certificate must not end the trainer of all plants."""
    with Controller(config, "controller-1") as controller, RunningTrainer(config) as trainer:
        huge = msgspec.structs.replace(
            controller.description, hidden=[4096] * LAYERS, activations=["tanh"] * LAYERS
        )
        controller.description = huge
        tracemalloc.start()
        try:
            controller.until(lambda h: h.counters.get("bad_controller_hidden_unusable", 0) >= 1)
            assert tracemalloc.get_traced_memory()[1] < 2**28
        finally:
            tracemalloc.stop()
        assert trainer.node.trainer is None
