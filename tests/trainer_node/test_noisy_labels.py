"""Trainings on labels with a variance: noise, early stopping, and the pace of trainings."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from protocol.messages import HiddenWeights, Sample
from tests.helpers.torch_network import h_hat_of
from tests.trainer_node.problem import CONFIG, DESCRIPTION, HIDDEN, K, make, output, samples, trained
from trainer_node.network import Network
from trainer_node.pace import Worth
from trainer_node.training import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def noisy(number: int, deviation: float, share: float = 1.0) -> list[Sample]:
    """Return samples of `share` of a smooth h whose labels have noise of this deviation in output scales."""
    rng, scale = np.random.default_rng(8), np.array(DESCRIPTION.output_scale)
    variance = ((deviation * scale) ** 2).tolist()
    return [
        msgspec.structs.replace(
            sample,
            h=(share * np.array(sample.h) + deviation * scale * rng.normal(size=4)).tolist(),
            variance=variance,
        )
        for sample in samples(0, number)
    ]


def trained_on(labels: list[Sample], weights: np.ndarray) -> tuple[Trainer, HiddenWeights | None]:
    trainer = Trainer(DESCRIPTION, CONFIG, 5, "trainer-1", HIDDEN)
    trainer.add("controller-1", labels)
    return trainer, trainer.train(output(trainer, weights=weights), "controller-1")


def test_noise_is_not_fitted_but_a_larger_h_is() -> None:
    still = np.zeros_like(K)
    still[1:] = 0.05 * np.random.default_rng(1).normal(size=K[1:].shape)
    trainer, found = trained_on(noisy(80, 1.0, share=0.0), still)
    assert found is None
    assert trainer.counters["kept_loss_not_lower"] == 1
    # The same numbers without a variance are fitted.
    exact = [msgspec.structs.replace(sample, variance=[]) for sample in noisy(80, 1.0, share=0.0)]
    _, fitted = trained_on(exact, still)
    assert fitted is not None
    assert fitted.loss_after < 0.99 * fitted.loss_before
    _, learned = trained_on(noisy(300, 0.1), K)
    assert learned is not None
    assert learned.loss_after < 0.9 * learned.loss_before


def test_held_out_samples_determine_where_to_stop() -> None:
    """The loss in the message is that of the sent layers, on samples that they were not trained on."""
    _, learned = trained_on(noisy(60, 0.3), K)
    assert learned is not None
    assert learned.samples == 45
    trainer = Trainer(DESCRIPTION, CONFIG, 5, "trainer-1", HIDDEN)
    trainer.add("controller-1", noisy(60, 0.3))
    draw = trainer.begin(output(trainer), "controller-1")
    assert draw is not None
    assert draw.problem.held_out is not None
    window, _ = draw.problem.held_out
    network = Network(DESCRIPTION)
    network.load([layer.numpy().astype(float) for layer in learned.layers])
    h_hat = h_hat_of(network, network.tensor(window), network.tensor(K)).numpy(force=True)
    labels = {tuple(sample.x + sample.u): sample.h for sample in noisy(60, 0.3)}
    error = (h_hat - [labels[tuple(row)] for row in window]) / DESCRIPTION.output_scale
    # The loss is relative to the labels' variance.
    np.testing.assert_allclose(learned.loss_after, np.mean((error / 0.3) ** 2), rtol=1e-4)


def test_the_last_of_a_few_steps_is_evaluated() -> None:
    trainer = Trainer(DESCRIPTION, msgspec.structs.replace(CONFIG, steps=7), 5, "trainer-1", HIDDEN)
    trainer.add("controller-1", noisy(300, 0.01))
    learned = trainer.train(output(trainer), "controller-1")
    assert learned is not None
    assert learned.loss_after < learned.loss_before


def test_the_newest_valid_sample_decides_whether_labels_are_noisy() -> None:
    trainer = Trainer(DESCRIPTION, CONFIG, 5, "trainer-1", HIDDEN)

    def holds_out() -> bool:
        draw = trainer.begin(output(trainer), "controller-1")
        assert draw is not None
        return draw.problem.held_out is not None

    trainer.add("controller-1", samples(0, 40))
    (bad,) = noisy(1, 1.0)
    trainer.add("controller-1", [msgspec.structs.replace(bad, seq=90, h=[float("nan")] * 4)])
    assert trainer.counters["bad_samples"] == 1
    assert not holds_out()
    trainer.add("controller-1", [msgspec.structs.replace(bad, seq=91)])
    assert holds_out()
    trainer.add("controller-2", samples(100, 1))
    assert not holds_out()


@pytest.mark.parametrize("variance", [[-1.0] * 4, [float("nan")] * 4, [1.0], [1e306] * 4])
def test_an_invalid_variance_makes_a_bad_sample(variance: list[float]) -> None:
    trainer = make(number=30)
    (bad,) = samples(50, 1)
    assert trainer.add("controller-1", [msgspec.structs.replace(bad, variance=variance)]) == 0
    assert trainer.counters["bad_samples"] == 1


def test_a_set_contains_its_newest_training_sample_with_noisy_labels() -> None:
    trainer, learned = trained_on(noisy(300, 0.1), K)
    assert learned is not None
    assert learned.newest == 299
    trainer.add("controller-2", noisy(10, 0.1))
    again = trainer.train(output(trainer), "controller-2")
    assert again is None or again.newest == 9
    exact = trained(make())
    assert exact.newest is msgspec.UNSET
    assert b"newest" not in msgspec.msgpack.encode(exact)


def test_an_unmeasured_state_does_not_prevent_learning_of_others() -> None:
    scale = np.array(DESCRIPTION.output_scale)
    blind = [
        msgspec.structs.replace(
            sample,
            h=(np.array(sample.h) + np.array([0.0, 0.0, 0.0, 30.0]) * scale * (-1) ** sample.seq).tolist(),
            variance=[*sample.variance[:3], float(1e3 * scale[3] ** 2)],
        )
        for sample in noisy(300, 0.1)
    ]
    _, learned = trained_on(blind, K)
    assert learned is not None
    assert learned.loss_after < 0.9 * learned.loss_before


def trainings(trainer: Trainer, first: int, number: int, share: float) -> list[int]:
    """Return the samples at which a training began, for labels of `share` h with as much noise as h."""
    began = []
    rng, scale = np.random.default_rng(first), np.array(DESCRIPTION.output_scale)
    for sample in samples(first, number):
        h = share * np.array(sample.h) + 0.3 * scale * rng.normal(size=4)
        noise = ((0.3 * scale) ** 2).tolist()
        trainer.add("controller-1", [msgspec.structs.replace(sample, h=h.tolist(), variance=noise)])
        if trainer.due(output(trainer, weights=np.zeros_like(K))):
            trainer.train(output(trainer, weights=np.zeros_like(K)), "controller-1")
            began.append(sample.seq)
    return began


def test_trainings_become_rare_without_gain_and_start_at_once_after_a_change() -> None:
    trainer = Trainer(DESCRIPTION, CONFIG, 5, "trainer-1", HIDDEN)
    # With K = 0 no hidden layers predict anything.
    calm = np.diff(trainings(trainer, 0, 600, share=0.0))
    assert list(calm[:3]) == [40, 80, 150]
    # The interval is at most a quarter of the buffer.
    assert set(calm[2:]) == {150}
    assert trainer.worth == Worth(0.0, pays=False)
    assert str(trainer.worth) == "training has nothing to gain (0.0% of the labels' variance)"
    risen = trainings(trainer, 600, 40, share=3.0)
    assert risen[0] < 625
    # Nothing is known about another controller's layers.
    trainer.resume(HIDDEN)
    assert trainings(trainer, 700, 30, share=0.0)[0] <= 709


def test_exact_labels_are_trained_on_at_the_usual_pace() -> None:
    trainer = make(number=0)
    began = []
    for sample in samples(0, 100):
        trainer.add("controller-1", [msgspec.structs.replace(sample, h=[0.0] * 4)])
        if trainer.due(output(trainer, weights=np.zeros_like(K))):
            trainer.train(output(trainer, weights=np.zeros_like(K)), "controller-1")
            began.append(sample.seq)
    assert began == list(range(19, 100, 10))
    assert trainer.worth is None
