"""The window of past pairs: its start, gaps, keyframes and the trainer."""

from __future__ import annotations

import itertools

import msgspec
import numpy as np
import pytest
import torch

from controller_node.outbox import BATCH, Outbox
from lbmpc.controller.signals import Observation, StepResult
from lbmpc.controller.state import ControllerState
from lbmpc.controller.step import Controller
from lbmpc.oracles import DnnOracle
from lbmpc.problem import build_problem
from lbmpc.solver.gauss_newton import Solver
from node_runtime.config.sections import TrainerConfig
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.science import compressor, describe, features
from tests.helpers.torch_network import phi_of
from trainer_node.network import Network
from trainer_node.training import Trainer

MODEL = compressor()
D, M = MODEL.d, MODEL.m
ORACLE = DnnOracle(describe(MODEL, [8, 8], architecture="rnn", window=4))
CONTROLLER = Controller(build_problem(MODEL, ORACLE, 8), Solver(build_problem(MODEL, ORACLE, 8)))


def run_controller(
    missing: tuple[int, ...] = (), ticks: int = 12
) -> list[tuple[ControllerState, StepResult]]:
    """Return the states after each tick and its result; x of tick t is t / 100, the input before it t / 10."""
    state, found = CONTROLLER.initial_state(0), []
    for t in range(ticks):
        x = None if t in missing else np.full(D, t / 100)
        applied = None if t == 0 else np.full(M, t / 10)
        state, result = CONTROLLER.step(state, Observation(x, applied, 1, t, None))
        found.append((state, result))
    return found


def pair(t: int, u: float) -> np.ndarray:
    return np.append(np.full(D, t / 100), u)


def test_a_window_starts_with_copies_of_the_first_state() -> None:
    found = run_controller()
    labels = [result.label for _state, result in found]
    assert labels[0] is None
    stood = pair(0, 0.0)  # the input at the first sample is not known, so the equilibrium's is used
    for t, expected in [
        (1, [stood, stood, stood]),
        (2, [stood, stood, pair(0, 0.1)]),
        (4, [pair(0, 0.1), pair(1, 0.2), pair(2, 0.3)]),
        (9, [pair(5, 0.6), pair(6, 0.7), pair(7, 0.8)]),
    ]:
        label = labels[t]
        assert label is not None
        np.testing.assert_array_equal(label.past, expected)


def test_a_gap_resets_the_window() -> None:
    found = run_controller(missing=(5,))
    assert [t for t, (_s, result) in enumerate(found) if result.label is None] == [0, 5, 6]
    label = found[7][1].label
    assert label is not None
    np.testing.assert_array_equal(label.past, [pair(6, 0.6)] * 3)
    label = found[8][1].label
    assert label is not None
    np.testing.assert_array_equal(label.past, [pair(6, 0.6), pair(6, 0.6), pair(6, 0.7)])


def test_the_predicted_state_contains_the_next_window() -> None:
    found = run_controller()
    state, result = found[6]
    np.testing.assert_array_equal(state.predicted[D:-M], found[7][0].oracle["past"].ravel()[:-M])
    assert state.predicted[-M] == result.plan[0, 0]


def test_the_window_is_saved_and_restored() -> None:
    state = run_controller()[-1][0]
    arrays = state.to_arrays()
    assert arrays["oracle.past"].shape == (3, D + M)
    again = ControllerState.from_arrays(arrays)
    seen = Observation(np.zeros(D), np.zeros(M), 1, 12, None)
    ours, theirs = CONTROLLER.step(state, seen)[1], CONTROLLER.step(again, seen)[1]
    np.testing.assert_array_equal(ours.plan, theirs.plan)
    assert not np.array_equal(
        CONTROLLER.step(ControllerState.from_arrays({**arrays, "oracle.past": np.ones((3, D + M))}), seen)[
            1
        ].plan,
        ours.plan,
    )


def test_trainer_and_controller_use_the_same_window() -> None:
    """This includes the start and the time after a gap: phi is the same on both sides."""
    trainer = Trainer(
        ORACLE.description,
        TrainerConfig(device="cpu"),
        0,
        "trainer",
        ORACLE.hidden(CONTROLLER.initial_state(0).oracle),
    )
    phis = []
    found = run_controller(missing=(5,))
    for (before, _), (_, result) in itertools.pairwise(found):
        label = result.label
        if label is not None:
            sample = m.Sample(
                len(phis), label.x.tolist(), label.u.tolist(), label.h.tolist(), label.past.tolist()
            )
            sample = msgspec.msgpack.decode(msgspec.msgpack.encode(sample), type=m.Sample)
            assert trainer.add("run", [sample]) == 1
            phis.append(features(ORACLE, before.oracle, label.x, label.u))
    network = Network(ORACLE.description, torch.float64)
    network.load(trainer.hidden)
    with torch.no_grad():
        theirs = phi_of(network, network.tensor(trainer.buffer.contents()[0])).numpy()
    np.testing.assert_allclose(theirs, phis, atol=1e-12)
    assert trainer.counters["bad_samples"] == 0
    short = m.Sample(99, [0.0] * D, [0.0] * M, [0.0] * D, [[0.0] * (D + M)] * 2)
    assert trainer.add("run", [short]) == 0
    assert trainer.counters["bad_samples"] == 1


def test_a_sample_without_a_past_keeps_its_format() -> None:
    sample = m.Sample(1, [0.5], [0.25], [0.125])
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(sample)) == {
        "seq": 1,
        "x": [0.5],
        "u": [0.25],
        "h": [0.125],
    }


def test_a_past_of_the_wrong_length_is_reported() -> None:
    batch = m.Samples(run_id="r", seq=0, samples=[m.Sample(0, [0.0] * 4, [0.0], [0.0] * 4, [[0.0] * 4])])
    with pytest.raises(codec.BadMessage, match=r"past\[0\] has 4 entries, the plant has 5"):
        codec.check_dimensions(topics.SAMPLES, batch, 4, 1)


def test_samples_with_a_long_past_fit_into_their_messages() -> None:
    sample = m.Sample(0, [0.1] * D, [0.1] * M, [0.1] * D, [[0.1] * (D + M)] * 63)
    samples = [msgspec.structs.replace(sample, seq=i) for i in range(BATCH)]
    batches = Outbox("run").batches(samples)
    assert sum(len(batch.samples) for batch in batches) == BATCH
    assert max(len(codec.encode(batch)) for batch in batches) <= topics.SAMPLES.max_bytes
