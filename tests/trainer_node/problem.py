"""Trainers of a network of the size used for the compressor, and samples of a smooth h."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from network_model.description import NetworkDescription, initial_hidden
from node_runtime.config.sections import TrainerConfig
from protocol.messages import Array, HiddenWeights, OutputWeights, Sample
from trainer_node.training import Trainer

DESCRIPTION = NetworkDescription(
    states=4,
    inputs=1,
    hidden=[32, 32],
    activations=["tanh", "tanh"],
    input_scale=[0.5, 0.5, 1.0, 20.0, 1.0],
    output_scale=[0.01, 0.01, 0.02, 0.01],
)
CONFIG = TrainerConfig(capacity=600, batch=256, device="cpu")
HIDDEN = initial_hidden(DESCRIPTION, np.random.default_rng(0))
K = np.random.default_rng(1).normal(size=(DESCRIPTION.features, 4)) * 0.1


def samples(first: int, number: int, seed: int = 2) -> list[Sample]:
    """Return samples of a smooth h of the same size as the compressor's."""
    rng = np.random.default_rng([seed, first])
    found = []
    for seq in range(first, first + number):
        v = rng.uniform(-1, 1, 5)
        x, u = v[:4] * DESCRIPTION.input_scale[:4], v[4:] * DESCRIPTION.input_scale[4:]
        h = np.array([-0.01 * v[0] ** 2, 0.01 * v[1] * v[4], 1e-5 * v[2], 0.0])
        found.append(Sample(seq=seq, x=x.tolist(), u=u.tolist(), h=h.tolist()))
    return found


def output(
    trainer: Trainer, seq: int = 40, weights: np.ndarray = K, sha256: str | None = None
) -> OutputWeights:
    return OutputWeights(
        run_id="controller-1",
        seq=seq,
        hidden_version=0,
        hidden_sha256=trainer.sha256 if sha256 is None else sha256,
        K=Array.of(weights),
    )


def make(config: TrainerConfig = CONFIG, number: int = 300, **changes: Any) -> Trainer:
    trainer = Trainer(DESCRIPTION, msgspec.structs.replace(config, **changes), 5, "trainer-1", HIDDEN)
    trainer.add("controller-1", samples(0, number))
    return trainer


def trained(trainer: Trainer, seq: int = 40) -> HiddenWeights:
    weights = trainer.train(output(trainer, seq), "controller-1")
    assert weights is not None, trainer.counters
    return weights
