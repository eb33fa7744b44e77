"""One trainer for several plants: results as for single plants, separation, and plants that come and go."""

from __future__ import annotations

import itertools
import threading
from concurrent.futures import Executor
from contextlib import ExitStack
from typing import Any, cast

import numpy as np
import pytest
import torch

from network_model.description import NetworkDescription, initial_hidden
from node_runtime.bus.lanes import Lanes
from node_runtime.bus.mailbox import Mailbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.sections import Config, TrainerConfig
from node_runtime.health import HealthPublisher
from node_runtime.rejected import RejectedMessages
from protocol.messages import Array, OutputWeights, Sample
from protocol.topics import Topic
from trainer_node.descent import Problem, descend_together
from trainer_node.fleet import discovery
from trainer_node.fleet.discovery import LastHeard, SharedRouter
from trainer_node.fleet.fleet import LOG_EVERY_S, Fleet, _Followed, seed_of
from trainer_node.node import COUNTERS, TrainerNode
from trainer_node.training import Draw, Trainer, use_one_thread
from trainer_node.training_round import MOST_STACKED, train_round

TRAINING = TrainerConfig(capacity=600, batch=128, steps=40, device="cpu")
SAMPLES = (128, 40, 300, 77)


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    use_one_thread()
    yield
    torch.set_num_threads(before)


def description(architecture: str = "mlp", window: int = 1) -> NetworkDescription:
    return NetworkDescription(
        states=2,
        inputs=1,
        hidden=[16, 16],
        activations=["tanh", "tanh"],
        input_scale=[0.5, 1.0, 1.0],
        output_scale=[0.01, 0.02],
        architecture=architecture,
        window=window,
        options={"kernel": 3} if architecture == "cnn" else {},
    )


class Pupil:
    """A plant's trainer with samples of its own plant, and the K for its training."""

    def __init__(self, network: NetworkDescription, number: int, samples: int):
        rng = np.random.default_rng([3, number])
        self.hidden = initial_hidden(network, rng)
        self.trainer = Trainer(network, TRAINING, number, "trainer", self.hidden)
        K = rng.normal(size=(network.features, 2)) * 0.2
        self.output = OutputWeights(
            run_id="c", seq=40, hidden_version=0, hidden_sha256=self.trainer.sha256, K=Array.of(K)
        )
        pairs = rng.uniform(-1, 1, (samples + network.window, 3))
        told = []
        for k in range(samples):
            past, (x, y, u) = pairs[k : k + network.window - 1], pairs[k + network.window - 1]
            h = [0.01 * np.sin(3 * x + number) * u, 0.02 * np.tanh(x * y)]
            told.append(Sample(k, [x, y], [u], h, past.tolist()))
        self.trainer.add("c", told)

    def draw(self) -> Draw:
        draw = self.trainer.begin(self.output, "c")
        assert draw is not None
        return draw


@pytest.mark.parametrize(("architecture", "window"), [("mlp", 1), ("rnn", 3), ("cnn", 4)])
def test_training_together_equals_training_alone(architecture: str, window: int) -> None:
    network = description(architecture, window)
    alone = [Pupil(network, k, count) for k, count in enumerate(SAMPLES)]
    found = [pupil.trainer.train(pupil.output, "c") for pupil in alone]
    together = [Pupil(network, k, count) for k, count in enumerate(SAMPLES)]
    draws = [pupil.draw() for pupil in together]
    descents = descend_together([draw.problem for draw in draws], TRAINING.steps, TRAINING.learning_rate)
    for pupil, one, draw, many in zip(together, found, draws, descents, strict=True):
        assert one is not None
        assert many.after < many.before
        assert many.before == pytest.approx(one.loss_before, rel=1e-5)
        assert many.after == pytest.approx(one.loss_after, rel=1e-3)
        sent = [layer.numpy() for layer in one.layers]
        moved = max(np.abs(a - b).max() for a, b in zip(sent, pupil.hidden, strict=True))
        apart = max(np.abs(a - b).max() for a, b in zip(sent, many.hidden, strict=True))
        # float32, 40 steps: only the order of the sums differs.
        assert apart < 1e-3 * moved
        assert pupil.trainer.finish(draw, many) is not None


def test_a_diverging_plant_does_not_affect_the_others() -> None:
    healthy = [Pupil(description(), k, 100) for k in range(3)]
    draws = [pupil.draw() for pupil in healthy]
    problems = [draw.problem for draw in draws]
    before = descend_together(problems, TRAINING.steps, TRAINING.learning_rate)
    one = problems[1]
    problems[1] = Problem(one.network, one.window, one.h * 1e30, one.K * 1e38)
    for pupil in healthy:
        pupil.draw()
    after = descend_together(problems, TRAINING.steps, TRAINING.learning_rate)
    assert not np.isfinite(after[1].after)
    assert healthy[1].trainer.finish(draws[1], after[1]) is None
    for k in (0, 2):
        assert after[k].after == before[k].after
        for a, b in zip(after[k].hidden, before[k].hidden, strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_silent_plant_is_dropped_and_can_return() -> None:
    heard = LastHeard("jet*")
    heard.note("tandem/jet1/controller/samples", 0.0)
    heard.note("tandem/pump/controller/samples", 0.0)
    assert heard.present(1.0) == ["jet1"]
    assert heard.present(1.0 + discovery.SILENT_S) == []
    heard.note("tandem/jet1/controller/samples", 20.0)
    assert heard.present(20.0) == ["jet1"]


def test_invented_names_do_not_fill_the_memory() -> None:
    heard = LastHeard("*")
    for k in range(discovery.MOST_PLANTS + 100):
        heard.note(f"tandem/x{k}/controller/samples", 0.0)
    assert len(heard.present(0.0)) == discovery.MOST_PLANTS


class NoPlants(SharedRouter):
    """A router without plants."""

    def __init__(self) -> None:
        super().__init__(Config(), "jet*", cast(Lanes, None))


def test_a_fleet_without_plants_logs_regularly(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    fleet = Fleet(NoPlants())
    for now in (0.0, 1.0, LOG_EVERY_S - 1.0, LOG_EVERY_S + 1.0):
        fleet.turn(now)
    assert caplog.messages == ["waiting for a plant that matches 'jet*'"] * 2


def test_a_plant_with_new_lanes_is_added_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """This happens after a round of training that took longer than the renewal of a certificate."""

    class Renewed(NoPlants):
        def present(self, now: float) -> list[str]:
            return ["jet1"]

    ended: list[str] = []
    taken: list[str] = []
    fleet, end = Fleet(Renewed()), ExitStack()
    end.callback(ended.append, "jet1")
    fleet._nodes["jet1"] = _Followed(cast(TrainerNode, None), cast(Lanes, "those before"), end)
    monkeypatch.setattr(Fleet, "_add_plant", lambda _fleet, name: taken.append(name))
    fleet._update_plants(0.0)
    assert (ended, taken) == (["jet1"], ["jet1"])


def test_the_seed_depends_on_the_name_and_not_on_the_order() -> None:
    assert seed_of(0, "jet1") == seed_of(0, "jet1") != seed_of(0, "jet2") != seed_of(1, "jet2")


class Silent:
    """Replaces a bus and a health publisher, and counts the published messages."""

    def __init__(self, config: Config):
        self.config, self.bad, self.run_id, self.published = config, RejectedMessages(), "trainer", 0

    def queue(self, topic: Topic, capacity: int, arrived: threading.Condition | None = None) -> Mailbox:
        return Mailbox(topic.name, capacity, arrived=arrived)

    def publish(self, _topic: Topic, _message: object) -> None:
        self.published += 1

    def set(self, _status: str, _note: str = "") -> None:
        pass


def waiting(network: NetworkDescription, number: int, since: float) -> tuple[TrainerNode, Silent]:
    """Return a plant that has waited for its training since the given time."""
    pupil, bus = Pupil(network, number, 40), Silent(Config(trainer=TRAINING))
    health, askers = cast(HealthPublisher, bus), cast(Executor, None)
    node = TrainerNode(bus.config, cast(Bus, bus), health, dict.fromkeys(COUNTERS, 0), askers)
    node._trainer, node._output, node._run = pupil.trainer, pupil.output, "c"
    node._waits_since = since
    return node, bus


def test_the_longest_waiting_plant_is_trained_first() -> None:
    wide = description("rnn", 3)
    since = np.random.default_rng(0).permutation(40)
    fleet_of = [waiting(wide if k % 4 == 0 else description(), k, float(since[k])) for k in range(40)]
    nodes, trained = [node for node, _ in fleet_of], []
    for turn in range(5):
        before = [bus.published for _, bus in fleet_of]
        train_round(nodes, 100.0 + turn)
        trained.append([k for k, (_, bus) in enumerate(fleet_of) if bus.published > before[k]])
    trained = [round_ for round_ in trained if round_]
    assert len(trained) == 3
    assert all(len(round_) <= MOST_STACKED for round_ in trained)
    assert sorted(k for round_ in trained for k in round_) == list(range(40))
    for round_, later in itertools.pairwise(trained):
        # The first plant of a round has waited longer than all plants of later rounds.
        assert min(since[round_]) < min(since[later])
    assert all(len({k % 4 == 0 for k in round_}) == 1 for round_ in trained)
