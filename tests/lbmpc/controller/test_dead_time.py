"""The dead time in labels, in the estimator and in the prediction."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lbmpc.controller.backup_policy import BackupPlanner
from lbmpc.controller.dead_time import Acted, InputLine, LineState, predicted
from lbmpc.controller.signals import Observation
from lbmpc.controller.state import ControllerState
from lbmpc.controller.step import Controller
from lbmpc.model import Model, ModelError, build_model
from lbmpc.oracles import DnnOracle, LinearOracle
from lbmpc.plants import Known, PlantDefinitionError, get_plant
from lbmpc.plants.linear_motion import Pieces, discretise
from lbmpc.problem import build_problem
from lbmpc.sets.certificate import CertificateError
from lbmpc.solver.gauss_newton import Solver
from tests.helpers.science import describe

T = 0.1


def linear_plant(rng: np.random.Generator, dead_time: float, m: int = 2) -> Known:
    return Known.from_matrices(
        rng.normal(0.0, 2.0, (3, 3)),
        rng.normal(0.0, 1.0, (3, m)),
        W=np.full(3, 0.1),
        x_min=-np.ones(3),
        x_max=np.ones(3),
        u_min=-np.ones(m),
        u_max=np.ones(m),
        dead_time=dead_time,
    )


class Delayed:
    """dx/dt = A x + B u(t - dead_time) + w, under random inputs with up to three switches per period."""

    def __init__(self, plant: Known, rng: np.random.Generator, w: np.ndarray, periods: int):
        self.plant, self.w = plant, w
        self.written: list[Pieces] = []
        for _ in range(periods):
            ends = [0.0, *np.sort(rng.uniform(0.0, T, rng.integers(0, 4))).tolist(), T]
            self.written.append(tuple((b - a, rng.uniform(-1.0, 1.0, plant.m)) for a, b in pairwise(ends)))

    def move(self, x: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return x(end) from x(begin)."""
        b = np.hstack([self.plant.B, np.eye(3)])
        t = 0.0
        for seconds, u in (piece for period in self.written for piece in period):
            since, t = t, t + seconds
            acts = min(end, t + self.plant.dead_time) - max(begin, since + self.plant.dead_time)
            if acts > 1e-12:
                phi, gamma = discretise(self.plant.A, b, acts)
                x = phi @ x + gamma @ np.concatenate([u, self.w])
        return x

    def seen(self, k: int, x: np.ndarray) -> Observation:
        """Return the sample at the end of period k - 1."""
        pieces = self.written[k - 1]
        applied = sum(seconds / T * u for seconds, u in pieces)
        return Observation(x, np.asarray(applied), 1, k, None, pieces if len(pieces) > 1 else ())


def dead_times() -> list[float]:
    rng = np.random.default_rng(7)
    return [T, 3 * T, 1.5 * T, 0.2 * T, *rng.uniform(0.0, 6.0 * T, 5).tolist()]


@pytest.mark.parametrize("dead_time", dead_times())
def test_labels_equal_the_true_h_and_predictions_the_true_motion(dead_time: float) -> None:
    rng = np.random.default_rng(int(1e6 * dead_time))
    plant = linear_plant(rng, dead_time)
    model, line, w = build_model(plant, T), InputLine(plant, T), rng.normal(0.0, 0.3, 3)
    h = discretise(plant.A, np.eye(3), T)[1] @ w
    windy, calm = Delayed(plant, rng, w, 24), Delayed(plant, rng, np.zeros(3), 24)
    calm.written = windy.written
    memory, before, first_label = line.initial_state(), None, 0
    # From here on every acting input was written during the test.
    first = math.ceil(dead_time / T - 1e-9) + 1
    x = rng.normal(0.0, 0.2, 3)
    for k in range(first, 17):
        memory, acted = line.advance(memory, windy.seen(k, x), 0.0)
        if acted.known and before is not None:
            first_label = first_label or k
            assert acted.seen.applied is not None
            label = model.label(before, acted.seen.applied, x, acted.seen.pieces)
            np.testing.assert_allclose(label, h, atol=1e-12 * max(1.0, np.abs(x).max()))
            # Predict from x to the time of a command in the middle of this period's first input.
            delay = 0.5 * windy.written[k][0][0]
            inputs = (*acted.ahead, (delay, windy.written[k][0][1]))
            found, _ = predicted(model, LinearOracle(3, 2), {}, x, inputs)
            there = calm.move(x, k * T, k * T + dead_time + delay)
            np.testing.assert_allclose(found, there, atol=1e-9 * max(1.0, np.abs(there).max()))
        before, x = x, windy.move(x, k * T, (k + 1) * T)
    # The period of the first sample is fully known, and the time before it is unknown.
    assert first_label == first + math.ceil(dead_time / T - 1e-9)


def test_without_a_dead_time_the_line_is_empty_and_has_no_effect() -> None:
    line = InputLine(linear_plant(np.random.default_rng(0), 0.0), T)
    seen = Observation(np.zeros(3), np.zeros(2), 1, 3, None)
    memory, acted = line.advance(line.initial_state(), seen, 0.01)
    assert memory == {} == line.commanded(memory, np.ones(2))
    assert acted.seen is seen
    assert (acted.known, acted.ahead) == (True, ())


# -- missing samples -------------------------------------------------------------------------------------------


PLANT = linear_plant(np.random.default_rng(1), 1.5 * T, m=1)
LINE = InputLine(PLANT, T)


def sample(k: int, *pieces: float, source: int = 1, applied: float | None = None) -> Observation:
    """Return a sample of equally long pieces with these inputs."""
    parts = tuple((T / len(pieces), np.array([u])) for u in pieces)
    mean = np.array([sum(pieces) / len(pieces) if applied is None else applied])
    return Observation(np.zeros(3), mean, source, k, None, parts if len(pieces) > 1 else ())


MISSING = Observation(None, None, 0, -1, None)


def after(*ticks: tuple[Observation, float], delay: float = 0.0) -> Acted:
    """Return the result of the last of these ticks; each is an observation and the command after it."""
    memory: LineState = LINE.initial_state()
    acted = Acted(MISSING, False, ())
    for seen, u in ticks:
        memory, acted = LINE.advance(memory, seen, delay)
        memory = LINE.commanded(memory, np.array([u]))
        assert sum(memory["written"][:, 0]) == pytest.approx(2.5 * T)
    return acted


def told(pieces: Pieces) -> list[tuple[float, float]]:
    return [(round(seconds / T, 9), round(float(u[0]), 9)) for seconds, u in pieces]


def test_a_lost_sample_is_assumed_as_commanded_and_gives_no_label() -> None:
    ticks = [(sample(k, 0.1 * k), 0.1 * (k + 1)) for k in range(4)]
    whole = after(*ticks, (sample(4, 0.4), 0.5), (sample(5, 0.5), 0.6))
    assert whole.known
    assert told(whole.seen.pieces) == [(0.5, 0.3), (0.5, 0.4)]
    lost = after(*ticks, (MISSING, 0.5), (sample(5, 0.5), 0.6))
    # The command of tick 3 acted from then on, as the sample would have reported.
    assert told(lost.seen.pieces) == told(whole.seen.pieces)
    assert told(lost.ahead) == told(whole.ahead) == [(0.5, 0.4), (1.0, 0.5)]
    # Half of the assumed period acts in this period, and half in the next one.
    assert not lost.known
    more = [(sample(k, 0.1 * k), 0.1 * (k + 1)) for k in range(6, 9)]
    assert not after(*ticks, (MISSING, 0.5), (sample(5, 0.5), 0.6), *more[:1]).known
    assert after(*ticks, (MISSING, 0.5), (sample(5, 0.5), 0.6), *more[:2]).known


def test_the_estimator_gets_the_assumed_inputs_of_a_missing_sample() -> None:
    ticks = [(sample(k, 0.1 * k), 0.1 * (k + 1)) for k in range(5)]
    acted = after(*ticks, (MISSING, 0.6))
    # The dead time is one and a half periods.
    assert told(acted.seen.pieces) == [(0.5, 0.3), (0.5, 0.4)]
    with_delay = after(*ticks, (MISSING, 0.6), delay=0.2 * T)
    assert told(with_delay.ahead) == [(0.7, 0.4), (0.8, 0.5)]


def test_skipped_ticks_and_late_samples_keep_the_timing() -> None:
    ticks = [(sample(k, 0.1 * k), 0.1 * (k + 1)) for k in range(6)]
    skipped = after(*ticks, (sample(7, 0.7), 0.8))
    assert told(skipped.ahead) == [(0.5, 0.6), (1.0, 0.7)]
    assert not skipped.known
    late = after(*ticks[:-1], (MISSING, 0.6), (sample(5, 0.5), 0.6))
    assert told(late.ahead) == told(after(*ticks).ahead)
    assert late.known


def test_a_plant_restart_and_a_long_gap_reset_the_line() -> None:
    ticks = [(sample(k, 0.1 * k), 0.1 * (k + 1)) for k in range(6)]
    for other in (sample(0, 0.9, source=2), sample(20, 0.9), sample(1, 0.9)):
        acted = after(*ticks, (other, 0.0))
        assert not acted.known
        assert told(acted.ahead) == [(1.5, 0.9)]
    # No known input acts: a plant that was held has its safe input in the line.
    held = Observation(np.zeros(3), None, 3, 0, None)
    assert told(after((held, 0.0)).ahead) == [(1.5, 0.0)]


@pytest.mark.parametrize("periods", [1, 2, 11])
def test_a_sample_as_late_as_the_memory_resets_the_line(periods: int) -> None:
    # For 2 and 11 periods of 0.1 s rounding puts the end of the memory behind the sample.
    line = InputLine(replace(PLANT, dead_time=periods * T), T)
    memory, _ = line.advance(line.initial_state(), sample(100, 0.4), 0.0)
    memory, acted = line.advance(memory, sample(100 - periods, 0.7), 0.0)
    assert told(acted.ahead) == [(periods, 0.7)]
    assert not acted.known


def test_surplus_inputs_are_replaced_by_their_mean() -> None:
    many = sample(1, *[0.1 * i for i in range(20)])
    memory, _ = LINE.advance(LINE.initial_state(), sample(0, 0.0), 0.0)
    for k in range(1, 60):
        memory, acted = LINE.advance(memory, replace(many, sequence=k), 0.0)
    assert acted.known
    assert acted.seen.applied is not None
    assert acted.seen.applied[0] == pytest.approx(0.95, abs=0.06)
    assert memory["written"].shape == LINE.initial_state()["written"].shape


def test_any_valid_sample_is_handled() -> None:
    rng, memory, known = np.random.default_rng(3), LINE.initial_state(), 0
    for _ in range(400):
        number = int(rng.choice([0, 1, 2**63 - 1, int(memory["sample"][1]) + int(rng.integers(-4, 5))]))
        pieces = tuple(
            (float(rng.choice([0.0, 1e-12, 0.3 * T, T, 1e300])), rng.uniform(-1.0, 1.0, 1))
            for _ in range(rng.integers(0, 30))
        )
        applied = None if rng.random() < 0.3 else np.zeros(1)
        seen = Observation(np.zeros(3), applied, 1, min(max(number, 0), 2**63 - 1), None, pieces)
        memory, acted = LINE.advance(memory, MISSING if rng.random() < 0.3 else seen, 0.2 * T)
        assert memory["written"].shape == LINE.initial_state()["written"].shape
        assert sum(memory["written"][:, 0]) == pytest.approx(2.5 * T)
        assert sum(seconds for seconds, _u in acted.ahead) == pytest.approx(1.5 * T)
        known += acted.known
    assert known


# -- in a step -------------------------------------------------------------------------------------------------


def model(dead_time: float = 0.0) -> Model:
    return build_model(replace(get_plant("moore_greitzer"), dead_time=dead_time), 0.05)


def test_prediction_advances_the_window_of_the_network() -> None:
    delayed = model(0.1)
    oracle = DnnOracle(describe(delayed, [6], architecture="rnn", window=3))
    state = oracle.begin(oracle.initial_state(np.random.default_rng(0)), np.full(4, 0.1), np.array([0.2]))
    x, inputs = np.array([0.05, 0.02, 0.01, 0.0]), ((0.01, np.array([0.3])), (0.1, np.array([0.4])))
    found, there = predicted(delayed, oracle, state, x, inputs)
    # Computed by hand: a partial period, and two whole ones under 0.4.
    first = delayed.ahead(x, np.array([0.3]), 0.01) + 0.2 * oracle.estimate(state, x, np.array([0.3]))
    pairs, at = state, first
    for _ in range(2):
        u = np.array([0.4])
        after = delayed.step(at, u) + oracle.estimate(pairs, at, u)
        pairs = {**pairs, "past": np.vstack([pairs["past"][1:], np.concatenate([at, u])])}
        at = after
    np.testing.assert_allclose(found, at, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(oracle.past(there), pairs["past"], rtol=1e-12, atol=1e-15)
    assert (oracle.past(there)[-2] == np.concatenate([first, [0.4]])).all()


def test_a_state_with_a_line_is_restored_from_its_arrays() -> None:
    delayed = model(0.12)
    problem = build_problem(delayed, LinearOracle(4, 1), 10, "none")
    controller = Controller(problem, Solver(problem))
    state = controller.initial_state(0)
    for k in range(5):
        seen = Observation(np.array([0.01 * k, 0.0, 0.0, 0.0]), np.array([0.01 * k]), 1, k, None)
        state, result = controller.step(state, seen)
        thawed = ControllerState.from_arrays(state.to_arrays())
        assert thawed.to_arrays().keys() == state.to_arrays().keys()
        for name, array in state.to_arrays().items():
            np.testing.assert_array_equal(thawed.to_arrays()[name], array)
        state = thawed
    assert result.label is not None
    # The dead time covers two periods and 0.4 of one.
    np.testing.assert_allclose(result.label.u, [0.4 * 0.01 + 0.6 * 0.02])


def test_options_that_exclude_a_dead_time_are_refused_by_name() -> None:
    delayed = model(0.1)
    with pytest.raises(CertificateError, match=r"dead time of 0\.1 s"):
        build_problem(delayed, LinearOracle(4, 1), 10, "invariant")
    with pytest.raises(ModelError, match="60 periods; at most 50"):
        model(3.0)
    for wrong in (-0.1, math.inf, math.nan, "soon"):
        with pytest.raises(PlantDefinitionError, match="dead_time"):
            linear_plant(np.random.default_rng(0), wrong)
    problem = build_problem(delayed, LinearOracle(4, 1), 10, "none")
    controller = Controller(problem, Solver(problem))
    seen = Observation(np.zeros(4), np.zeros(1), 1, 0, None)
    state, _ = controller.step(controller.initial_state(0), seen)
    assert controller.backup(BackupPlanner(problem, 0.01), state) is None


def test_a_log_contains_the_dead_time_only_if_there_is_one() -> None:
    plant = linear_plant(np.random.default_rng(0), 0.25)
    assert Known.from_builtins(plant.to_builtins()).dead_time == 0.25
    assert "dead_time" not in replace(plant, dead_time=0.0).to_builtins()
    assert plant.changed({}, dead_time=0.3).dead_time == 0.3
