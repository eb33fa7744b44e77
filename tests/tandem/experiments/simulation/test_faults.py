"""Faults in lock-step runs, the oracle with the true h, K refitted at an adoption, and Lemma 1 on a real run."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.build import build_oracle
from controller_node.core import ControllerCore
from lbmpc.model import build_model
from lbmpc.oracles import DnnOracle, PerfectOracle
from lbmpc.oracles.dnn.adaptation_law import refit
from lbmpc.plants import PlantError, Truth, get_plant
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from run_log.replaying.replay import replay
from run_log.run import Run
from tandem.experiments.simulation.faults import Drift, Faults
from tandem.experiments.simulation.lockstep import follow
from tandem.experiments.study.lemma import measure
from tests.helpers.science import function

PLANT = get_plant("moore_greitzer")
SETTINGS = [
    "controller.solver.compile=never",
    "controller.horizon=15",
    "network.hidden=[6]",
    "trainer.steps=5",
]


def config(*more: str) -> Config:
    return load(None, [*SETTINGS, *more])


def states(run: Run) -> np.ndarray:
    return np.array([state.x for state in run.plant_states])


@pytest.mark.parametrize(
    ("rate", "parameters"),
    [(10.0, {}), (20.0, {}), (100.0, {}), (20.0, {"slope": 1.3, "beta": 0.8, "z_c": 0.05})],
)
def test_the_perfect_oracle_knows_h_and_its_slopes(rate: float, parameters: dict[str, float]) -> None:
    model, true_plant = build_model(PLANT, 1 / rate), PLANT.varied(**parameters)
    oracle = PerfectOracle(model, true_plant)
    truth, evaluate = Truth(true_plant), function(oracle)
    rng = np.random.default_rng(5)
    theta = oracle.theta(oracle.initial_state(rng))

    def h(xu: np.ndarray) -> np.ndarray:
        x, u = xu[:4], xu[4:]
        after = truth.step(x + PLANT.x_e, u + PLANT.u_e, model.period) - PLANT.x_e
        return model.label(x, u, after)

    followed = 0
    for _ in range(20):
        xu = np.concatenate([rng.uniform(PLANT.x_min, PLANT.x_max) - PLANT.x_e, rng.uniform(-1, 1, 1)])
        xu[3] *= 0.5
        try:
            expected = h(xu)
            numeric = np.column_stack([(h(xu + step) - h(xu - step)) / 2e-4 for step in 1e-4 * np.eye(5)])
        except PlantError:
            continue
        followed += 1
        value, slopes = (np.array(part) for part in evaluate(xu[:4], xu[4:], theta))
        np.testing.assert_allclose(value[:, 0], expected, atol=2e-9)
        np.testing.assert_allclose(slopes, numeric, atol=2e-6)
    assert followed >= 15


def test_refitted_weights_explain_the_samples_and_stay_within_their_bounds() -> None:
    rng = np.random.default_rng(1)
    phi, true = rng.normal(size=(80, 5)), rng.normal(size=(5, 2))
    K, wide = np.zeros((5, 2)), np.full(2, 100.0)
    np.testing.assert_allclose(refit(K, phi, phi @ true, 1e-9, wide), true, atol=1e-6)
    np.testing.assert_allclose(refit(K + 1.0, phi, phi @ true, 1e9, wide), K + 1.0, atol=1e-6)
    tight = refit(K, phi, phi @ true, 1e-9, np.full(2, 0.1))
    np.testing.assert_allclose(np.linalg.norm(tight, axis=0), 0.1)


def test_refit_at_an_adoption_changes_K_and_replays() -> None:
    kept, fitted = (follow(config(f"adaptation.at_adoption={how}"), 40).run for how in ("keep", "refit"))
    adopted = [r.seq for r in fitted.results if r.weights_outcome == "adopted"]
    assert adopted
    first = adopted[0]
    K = {
        name: {w.seq: w.K.numpy() for w in run.output_weights}
        for name, run in (("kept", kept), ("fitted", fitted))
    }
    np.testing.assert_array_equal(K["kept"][first - 1], K["fitted"][first - 1])
    assert np.abs(K["kept"][first] - K["fitted"][first]).max() > 1e-6
    assert replay(fitted).equal


def test_without_adaptation_the_last_layer_stays() -> None:
    run = follow(config("adaptation.enabled=false"), 30).run
    weights = [w.K.numpy() for w in run.output_weights]
    np.testing.assert_array_equal(weights[0], weights[-1])
    assert any(r.weights_outcome == "adopted" for r in run.results)


def test_the_three_starts_of_K() -> None:
    model = build_model(PLANT, 0.05)
    at = np.random.default_rng(0).uniform(-1, 1, (200, 5)) * np.array([0.5, 0.5, 1.0, 20.0, 1.0])
    size = {}
    for start in ("zero", "random", "pretrained"):
        oracle = build_oracle(config(f"adaptation.start={start}"), model)
        state = oracle.initial_state(np.random.default_rng(7))
        size[start] = max(np.abs(oracle.estimate(state, xu[:4], xu[4:])).max() for xu in at)
    assert size["zero"] == 0.0
    assert 0.0 < size["pretrained"] < 0.5 * size["random"]


def test_noise_is_in_the_measurements_and_not_in_the_truth() -> None:
    noisy = config("controller.oracle=linear", "plant.sensors.noise={z=0.002, y=0.002}")
    run = follow(noisy, 40).run
    measured = np.array([tick.state.x for tick in run.ticks if tick.state is not None])
    difference = measured - states(run)[:-1]
    assert 0.0005 < difference[:, :2].std() < 0.0015
    assert not difference[:, 2:].any()
    again = follow(noisy, 40).run
    np.testing.assert_array_equal(states(run), states(again))
    assert replay(run).equal


def test_a_late_command_acts_later_and_the_controller_knows_it() -> None:
    run = follow(config("controller.oracle=linear"), 20, Faults(command_seconds=0.01)).run
    pieces = [[piece.seconds for piece in tick.state.pieces] for tick in run.ticks[2:] if tick.state]
    assert len(pieces) == 18
    for seconds in pieces:
        assert seconds == pytest.approx([0.01, 0.04])
    assert replay(run).equal
    with pytest.raises(ConfigError, match=r"command_seconds = 0.05 is not less than a period, 0.05 s"):
        follow(config("controller.oracle=linear"), 1, Faults(command_seconds=0.05))


def test_a_late_trainer_is_late_and_trains_once_at_a_time() -> None:
    run = follow(config(), 60, Faults(training_seconds=1.0)).run
    arrived = [tick.seq for tick in run.ticks if tick.weights is not None]
    # 20 samples exist at tick 20; the training then takes 20 ticks.
    assert arrived == [40]


def test_a_dead_trainer_sends_nothing() -> None:
    run = follow(config(), 60, Faults(trainer_dies_at=1.5)).run
    arrived = [tick.seq for tick in run.ticks if tick.weights is not None]
    assert arrived
    assert max(arrived) <= 30


def test_a_drifting_plant_moves_by_its_new_parameters() -> None:
    calm = states(follow(config("controller.oracle=linear"), 40).run)
    for over in (0.0, 0.5):
        faults = Faults(drift=Drift(to={"slope": 1.4}, at=1.0, over=over))
        moved = states(follow(config("controller.oracle=linear"), 40, faults).run)
        np.testing.assert_array_equal(calm[:21], moved[:21])
        assert np.abs(calm - moved)[30:].max() > 1e-3


def prediction_errors(run: Run) -> np.ndarray:
    return np.array([r.prediction_error for r in run.results if r.prediction_error is not None])


def test_the_true_plant_moves_by_its_own_parameters_and_only_perfect_knows() -> None:
    runs = {
        (oracle, slope): follow(config(f"controller.oracle={oracle}", f"plant.truth.slope={slope}"), 20).run
        for oracle in ("linear", "perfect")
        for slope in (1.5, 1.4)
    }
    truth = Truth(PLANT.varied(slope=1.4))
    run = runs["linear", 1.4]
    for state, after, command in zip(run.plant_states, run.plant_states[1:], run.commands, strict=False):
        np.testing.assert_allclose(
            truth.step(np.array(state.x), np.array(command.u), 0.05), after.x, atol=1e-12
        )
    # The model is the nominal one: its first plan does not depend on the truth.
    assert runs["linear", 1.4].commands[0].plan == runs["linear", 1.5].commands[0].plan
    assert np.abs(states(runs["linear", 1.4]) - states(runs["linear", 1.5])).max() > 1e-2
    assert prediction_errors(runs["perfect", 1.4]).max() < 1e-8
    assert runs["perfect", 1.4].commands[0].plan != runs["perfect", 1.5].commands[0].plan
    assert replay(runs["perfect", 1.4]).equal


@pytest.mark.parametrize("over", [0.0, 0.5])
def test_perfect_knows_the_present_equations_of_a_plant_that_drifts_and_replays(over: float) -> None:
    faults = Faults(drift=Drift(to={"slope": 1.4, "z_c": 0.05}, at=1.0, over=over))
    run = follow(config("controller.oracle=perfect", "controller.keyframe_every=7"), 45, faults).run
    assert prediction_errors(run).max() < 1e-8
    told = [tick.seq for tick in run.ticks if tick.truth]
    assert told[0] == 20
    assert told[-1] == (30 if over else 20)
    assert run.ticks[told[-1]].truth == {"beta": 1.0, "z_c": 0.05, "slope": 1.4}
    known = [keyframe.arrays["oracle.parameters"].numpy().tolist() for keyframe in run.keyframes]
    assert known[0] == [1.0, 0.0, 1.5]
    assert known[-1] == [1.0, 0.05, 1.4]
    assert replay(run).equal
    assert replay(run, from_tick=30).equal


@pytest.mark.parametrize("setting", ["plant.truth.slope=1e9", "rate=1e-6"])
def test_a_truth_too_fast_for_perfect_is_refused_and_takes_no_memory(setting: str) -> None:
    config_too_fast = config("controller.oracle=perfect", setting)
    with pytest.raises(ConfigError, match=r"too fast|not Schur stable|no stabilising K"):
        ControllerCore(config_too_fast, "controller")


def test_only_perfect_knows_of_a_drift() -> None:
    faults = Faults(drift=Drift(to={"slope": 1.4}, at=1.0))
    run = follow(config("controller.oracle=l2nw"), 25, faults).run
    assert prediction_errors(run)[20] > 1e-4
    assert replay(run).equal


def test_faults_that_do_not_fit_the_plant_are_named() -> None:
    with pytest.raises(ConfigError, match=r"faults\.drift: .* no parameter 'bta'; did you mean 'beta'"):
        follow(config(), 5, Faults(drift=Drift(to={"bta": 2.0}, at=0.0)))
    with pytest.raises(ConfigError, match=r"plant\.sensors\.noise: .* no state 'zz'; did you mean 'z'"):
        follow(config("plant.sensors.noise={zz=0.1}"), 5)


def test_lemma_1_holds_on_a_real_run() -> None:
    settings = config("network.hidden=[16]")
    oracle = build_oracle(settings, build_model(PLANT, settings.period))
    assert isinstance(oracle, DnnOracle)
    run = follow(settings, 80).run
    found = measure(run, oracle)
    assert found is not None
    logged = [r.prediction_error**2 for r in run.results if r.prediction_error is not None]
    np.testing.assert_allclose(found.error, logged, rtol=1e-9, atol=1e-18)
    assert (found.accumulated <= found.bound).all()
    assert (found.bound <= found.bound_beforehand).all()


@pytest.mark.parametrize("ms", [2.0, 10.0])
def test_a_known_delay_is_predicted_over_from_the_first_tick_that_follows_one(ms: float) -> None:
    settings = ["controller.oracle=linear", "trainer.enabled=false", f"controller.input_delay_ms={ms}"]
    run = follow(config(*settings), 4, Faults(command_seconds=1e-3 * ms)).run
    assert run.ticks[1].state is not None
    assert run.ticks[1].state.applied is None
    # At the second tick the plant moves under the first command until the second one acts.
    u = np.array(run.ticks[1].state.pieces[-1].u)
    core = ControllerCore(config(*settings), "controller")
    model, u_e = core.controller.model, core.plant.u_e
    for tick in run.ticks[:2]:
        command = core.step(tick).command
    start = model.ahead(np.array(run.ticks[1].state.x) - core.plant.x_e, u - u_e, 1e-3 * ms)
    expected = model.step(start, np.array(command.u) - u_e)
    assert core.memory.state.predicted == pytest.approx(expected, abs=1e-9)
    assert [result.input_delay for result in run.results] == pytest.approx([1e-3 * ms] * 4)
    assert replay(run).equal
