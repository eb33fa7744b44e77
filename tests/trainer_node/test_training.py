"""The slow timescale: the effect of a training, its inputs, and reasons to keep the old hidden layers."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from network_model.description import hash_layers, initial_hidden
from node_runtime.config.sections import TrainerConfig
from protocol.messages import HiddenWeights
from tests.helpers.paths import ROOT
from tests.helpers.torch_network import h_hat_of
from tests.trainer_node.problem import CONFIG, DESCRIPTION, HIDDEN, K, make, output, samples, trained
from trainer_node.network import DenseLoss, Network
from trainer_node.training import Trainer, TrainerError, pick_device

pytestmark = pytest.mark.usefixtures("one_thread")


def losses(weights: list[np.ndarray]) -> float:
    """Return the loss over all 300 samples, computed in numpy."""
    total = 0.0
    for sample in samples(0, 300):
        activation = np.concatenate([sample.x, sample.u]) / DESCRIPTION.input_scale
        for layer in weights:
            activation = np.tanh(layer[0] + activation @ layer[1:])
        h_hat = DESCRIPTION.output_scale * (K.T @ np.concatenate([[1.0], activation]))
        total += float(np.sum(((h_hat - sample.h) / DESCRIPTION.output_scale) ** 2))
    return total / 300


def test_a_training_lowers_the_paper_s_loss_for_fixed_K() -> None:
    trainer = make(batch=300)
    asked = output(trainer)
    before = asked.K.data
    weights = trainer.train(asked, "controller-1")
    assert weights is not None
    assert asked.K.data == before
    assert weights.loss_before == pytest.approx(losses(HIDDEN), rel=1e-5)
    assert weights.loss_after == pytest.approx(losses(trainer.hidden), rel=1e-4)
    assert weights.loss_after < 0.5 * weights.loss_before
    assert weights.samples == 300


def test_the_message_identifies_its_training_data() -> None:
    trainer = make()
    first = trained(trainer, 40)
    second = trained(trainer, 60)
    assert (first.run_id, first.for_run, first.trained_on) == ("trainer-1", "controller-1", 40)
    assert [first.seq, second.seq] == [1, 2]
    assert first.base_sha256 == hash_layers(HIDDEN)
    assert second.base_sha256 == first.sha256
    assert first.network_sha256 == DESCRIPTION.sha256()
    layers = [layer.numpy() for layer in second.layers]
    assert [layer.dtype for layer in second.layers] == ["<f4", "<f4"]
    assert hash_layers(layers) == second.sha256 == trainer.sha256
    assert all((a == b).all() for a, b in zip(layers, trainer.hidden, strict=True))
    assert first.samples == CONFIG.batch


def run_of_trainings(config: TrainerConfig, seed: int = 5) -> list[HiddenWeights]:
    trainer = Trainer(DESCRIPTION, config, seed, "trainer-1", HIDDEN)
    found = []
    for start in range(0, 900, 150):
        trainer.add("controller-1", samples(start, 150))
        found.append(trained(trainer, start))
    return found


@pytest.mark.parametrize("strategy", ["fifo", "reservoir", "novelty"])
def test_the_same_seed_gives_the_same_weights_bit_for_bit(strategy: Any) -> None:
    config = TrainerConfig(capacity=200, batch=64, steps=20, strategy=strategy, device="cpu")
    assert run_of_trainings(config) == run_of_trainings(config)
    assert run_of_trainings(config)[-1].sha256 != run_of_trainings(config, seed=6)[-1].sha256


def test_another_process_trains_the_same_bits() -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n"
        "import tests.trainer_node.problem as t, trainer_node.training\n"
        "trainer_node.training.use_one_thread()\n"
        "sys.stdout.write(t.trained(t.make()).sha256)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert found.stdout == trained(make()).sha256


def test_a_training_is_due_after_enough_new_samples() -> None:
    trainer = make(number=0, train_every=20, min_samples=50)
    for first in range(0, 40, 20):
        trainer.add("controller-1", samples(first, 20))
        assert not trainer.due(output(trainer))
    trainer.add("controller-1", samples(40, 10))
    assert trainer.due(output(trainer))
    trained(trainer)
    assert not trainer.due(output(trainer))
    trainer.add("controller-1", samples(30, 20))
    assert trainer.counters["samples_met_before"] == 20
    trainer.add("controller-1", samples(50, 19))
    assert not trainer.due(output(trainer))
    trainer.add("controller-1", samples(69, 1))
    assert trainer.due(output(trainer))


def test_invalid_samples_do_not_reach_the_buffer() -> None:
    trainer = make(number=30)
    good = samples(30, 1)[0]
    bad = [
        msgspec.structs.replace(good, x=[float("nan"), 0.0, 0.0, 0.0]),
        msgspec.structs.replace(good, h=[0.0, float("inf"), 0.0, 0.0]),
        msgspec.structs.replace(good, u=[]),
        msgspec.structs.replace(good, h=[0.0]),
    ]
    assert trainer.add("controller-1", [*bad, good]) == 1
    assert trainer.counters["bad_samples"] == 4
    assert len(trainer.buffer) == 31
    assert np.isfinite(trained(trainer).loss_after)


def broken_loss(value: float) -> Callable[[DenseLoss], torch.Tensor]:
    def gradient(self: DenseLoss) -> torch.Tensor:
        return torch.full_like(self._gradient, value)

    return gradient


def flipped(self: DenseLoss, right: Callable[[DenseLoss], torch.Tensor] = DenseLoss.gradient) -> torch.Tensor:
    return right(self).neg()


@pytest.mark.parametrize(
    ("gradient", "reason"),
    [
        (broken_loss(float("nan")), "kept_not_finite"),
        (flipped, "kept_loss_not_lower"),
        (broken_loss(0.0), "kept_loss_not_lower"),
    ],
)
def test_a_failed_training_keeps_the_old_layers(
    monkeypatch: pytest.MonkeyPatch, gradient: Any, reason: str
) -> None:
    trainer = make()
    monkeypatch.setattr(DenseLoss, "gradient", gradient)
    assert trainer.train(output(trainer), "controller-1") is None
    assert trainer.counters[reason] == 1
    assert trainer.sha256 == hash_layers(HIDDEN)
    assert trainer.version == 0
    monkeypatch.undo()
    assert trained(trainer).base_sha256 == hash_layers(HIDDEN)


@pytest.mark.parametrize(
    ("weights", "reason"),
    [
        (np.full_like(K, np.nan), "kept_k_is_not_finite"),
        (np.full_like(K, 1e300), "kept_k_is_too_large"),
        (K[:, :3], "kept_k_has_the_wrong_shape"),
        (K[:-1], "kept_k_has_the_wrong_shape"),
    ],
)
def test_unusable_output_weights_are_reported(weights: np.ndarray, reason: str) -> None:
    trainer = make()
    assert trainer.train(output(trainer, weights=weights), "controller-1") is None
    assert trainer.counters[reason] == 1


def test_layers_that_the_controller_would_refuse_are_not_published() -> None:
    norm = float(np.linalg.norm(HIDDEN[1]))
    tight = msgspec.structs.replace(DESCRIPTION, max_layer_norm=norm * 1.0001)
    trainer = Trainer(tight, CONFIG, 5, "trainer-1", HIDDEN)
    trainer.add("controller-1", samples(0, 300))
    assert trainer.train(output(trainer), "controller-1") is None
    assert trainer.counters["kept_norm_bound"] == 1


def test_a_training_continues_from_the_layers_of_K() -> None:
    """The controller did not adopt the last weights, so K was adapted to the ones before."""
    trainer = make()
    first = trained(trainer)
    second = trained(trainer)
    again = trainer.train(output(trainer, sha256=first.sha256), "controller-1")
    assert again is not None
    assert again.base_sha256 == first.sha256
    assert again.seq == second.seq + 1
    # The drawn samples differ, and so do the layers, but both trainings began at nearly the same loss.
    assert again.loss_before == pytest.approx(second.loss_before, rel=0.3)
    assert trainer.train(output(trainer, sha256="0" * 64), "controller-1") is None
    assert trainer.counters["kept_k_belongs_to_unknown_hidden_weights"] == 1


def test_a_training_continues_from_a_snapshot_with_its_samples() -> None:
    trainer = make()
    trained(trainer)
    other = initial_hidden(DESCRIPTION, np.random.default_rng(9))
    trainer.resume(other, version=17)
    weights = trained(trainer)
    assert weights.seq == 18
    assert weights.base_sha256 == hash_layers(other)
    assert len(trainer.buffer) == 300
    with pytest.raises(ValueError, match="shapes"):
        trainer.resume(other[:1])


def test_a_missing_device_is_reported() -> None:
    if torch.cuda.is_available():
        assert pick_device("cuda").type == "cuda"
    else:
        with pytest.raises(TrainerError, match=r"trainer\.device"):
            pick_device("cuda")
        assert pick_device("auto").type == "cpu"
    assert pick_device("cpu").type == "cpu"


@pytest.mark.parametrize("activations", [["tanh", "sigmoid"], ["relu", "softsign"], ["softplus", "tanh"]])
def test_the_handwritten_gradient_equals_autograd(activations: Any) -> None:
    description = msgspec.structs.replace(DESCRIPTION, hidden=[7, 5], activations=activations)
    rng = np.random.default_rng(3)
    network = Network(description, torch.float64)
    network.load([rng.normal(size=shape) for shape in description.layer_shapes])
    weights, xu, h = rng.normal(size=(6, 4)), rng.normal(size=(50, 5)), 0.01 * rng.normal(size=(50, 4))
    by_hand = DenseLoss(network, xu, h, weights)
    error = network.scaled_targets(
        h_hat_of(network, network.tensor(xu), network.tensor(weights)) - network.tensor(h)
    )
    loss = error.square().sum(dim=1).mean()
    loss.backward()
    assert by_hand.value() == pytest.approx(loss.item(), rel=1e-12)
    torch.testing.assert_close(by_hand.gradient(), network.flat.grad, rtol=1e-10, atol=1e-12)


def test_a_training_is_quick() -> None:
    """200 steps on 512 samples take about 40 ms of one core; the limit leaves room for slow machines."""
    trainer = make(batch=512, capacity=2000, number=600)
    taken = []
    for _ in range(3):
        start = time.thread_time()
        trained(trainer)
        taken.append(time.thread_time() - start)
    assert min(taken) < 0.3, taken
