"""Noise and an estimator in the whole loop: figures come from the true motion, and a log replays byte for byte."""

from __future__ import annotations

import io

import msgspec
import numpy as np
import pytest
from rich.console import Console

from controller_node.core import ControllerCore
from lbmpc.plants import get_plant
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.run import Run
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow, simulate
from tandem.summary_table import table

PLANT = get_plant("moore_greitzer")
SETTINGS = [
    "controller.solver.compile=never",
    "controller.horizon=15",
    "controller.keyframe_every=20",
    "network.hidden=[6]",
    "trainer.steps=20",
    "plant.x0=[0.4, 1.6, 1.1547, 0]",
    "plant.sensors.noise=0.01",
    "estimator.kind=kalman",
]


def config(*more: str) -> Config:
    return load(None, [*SETTINGS, *more])


def true(run: Run) -> np.ndarray:
    return np.array([state.x for state in run.plant_states])


@pytest.fixture(scope="module")
def lossy() -> Run:
    return follow(
        config("plant.sensors.dropouts=0.1", "adaptation.law=kalman"), 80, Faults(command_seconds=0.01)
    ).run


def test_it_replays_byte_for_byte_from_the_beginning_and_from_the_middle(lossy: Run) -> None:
    lost = [tick.seq for tick in lossy.ticks if tick.state is None]
    assert 2 <= len(lost) <= 20
    assert all(lossy.ticks[seq].state_verdict == "missing" for seq in lost)
    assert replay(lossy).equal
    middle = replay(lossy, from_tick=45)
    assert middle.equal
    assert middle.first_tick > 20


def test_samples_have_the_variance_of_their_labels(lossy: Run) -> None:
    assert len(lossy.samples) > 40
    for sample in lossy.samples:
        assert len(sample.variance) == 4
        # At least the noise of one measurement.
        assert (np.array(sample.variance) >= (0.01 * PLANT.x_scale) ** 2 * (1 - 1e-9)).all()
    exact = simulate(config("estimator.kind=none"), 10)
    assert all(sample.variance == [] for sample in exact.samples)
    assert not any(name.startswith("estimator") for name in exact.keyframes[0].arrays)
    assert "oracle.evidence" not in exact.keyframes[0].arrays


def test_a_result_has_the_weight_of_the_network_and_the_deviation_of_the_state(lossy: Run) -> None:
    after = [result for result in lossy.results if result.seq >= 5]
    deviations = np.array([result.deviation for result in after])
    # Better than one sample, and worse after a missing one.
    known = np.array([lossy.ticks[result.seq].state is not None for result in after])
    assert (deviations[known] < 0.01 * PLANT.x_scale).all()
    assert deviations[~known].mean() > deviations[known].mean()
    for result in after:
        for weight in (result.weight, result.constant_weight):
            assert len(weight) == 4
            assert all(0.0 <= share <= 1.0 for share in weight)
    summary = summarise(lossy)
    last = np.mean([result.weight for result in lossy.results[-20:]], axis=0)
    assert summary.weight == pytest.approx(dict(zip(PLANT.states, last, strict=True)))
    console = Console(width=200, file=io.StringIO())
    console.print(table(msgspec.structs.replace(summary, weight={"z": 0.02}, constant_weight={"z": 0.01})))
    console.print(table(msgspec.structs.replace(summary, weight={"z": 0.02}, constant_weight={"z": 0.4})))
    assert console.file.getvalue().count("noise exceeds h") == 1
    exact = simulate(config("estimator.kind=none"), 3)
    assert all(not (r.weight or r.constant_weight or r.deviation) for r in exact.results)
    assert summarise(exact).weight is None


def test_the_memory_outlives_its_process_without_the_plan(lossy: Run) -> None:
    core = ControllerCore(config("adaptation.law=kalman"), "controller-a")
    core.memory.restore(lossy.keyframes[2])
    again = ControllerCore(config("adaptation.law=kalman"), "controller-b")
    again.memory.go_on(core.memory.lasting(), "controller-a")
    for name in ("x", "disturbance", "covariance", "sample"):
        np.testing.assert_array_equal(again.memory.state.estimator[name], core.memory.state.estimator[name])
    # From there both continue equally, and a log of either replays.
    for tick in lossy.ticks[60:70]:
        core.step(tick)
        again.step(tick)
    np.testing.assert_array_equal(again.memory.state.estimator["x"], core.memory.state.estimator["x"])


def test_noise_that_is_found_is_in_every_tick_in_keyframes_and_in_checkpoints() -> None:
    settings = config("estimator.noise=innovations", "controller.oracle=linear", "plant.sensors.noise=0.002")
    run = follow(settings, 120).run
    first, last = np.array(run.results[5].noise), np.array(run.results[-1].noise)
    np.testing.assert_allclose(first, 0.01 * PLANT.x_scale)
    np.testing.assert_allclose(last / PLANT.x_scale, 0.002, rtol=0.5)
    assert summarise(run).noise == dict(zip(PLANT.states, last, strict=True))
    assert replay(run).equal
    # While the noise is being estimated.
    assert replay(run, from_tick=45).equal
    core = ControllerCore(settings, "controller-a")
    core.memory.restore(run.keyframes[3])
    again = ControllerCore(settings, "controller-b")
    again.memory.go_on(core.memory.lasting(), "controller-a")
    for memory in (core.memory, again.memory):
        assert memory.state.estimator["finder.counts"][1] > 40
    for tick in run.ticks[61:70]:
        core.step(tick)
        again.step(tick)
    for name, array in core.memory.state.estimator.items():
        np.testing.assert_array_equal(again.memory.state.estimator[name], array)
    told = simulate(config("controller.oracle=linear"), 5)
    assert told.results[-1].noise == []


def test_half_of_the_states_measured_and_a_wrong_start_is_survived() -> None:
    settings = ["controller.oracle=linear", 'estimator.measured=["z", "y"]']
    begun = [0.4, 1.6, 1.1547 + 0.3, 5.0]
    outcome = follow(config(*settings, f"plant.x0={begun}"), 200)
    assert outcome.lost is None
    assert (np.abs(true(outcome.run)[-20:] - PLANT.x_e) < 0.1 * PLANT.x_scale).all()


def test_learning_costs_little_more_than_the_nominal_model_where_noise_exceeds_h() -> None:
    def J(*more: str) -> float:
        run = simulate(config("controller.horizon=20", *more), 150)
        off, inputs = true(run)[:-1] - PLANT.x_e, np.array([r.u for r in run.results]) - PLANT.u_e
        return float((off**2).sum() + (inputs**2).sum()) / 20.0

    linear = J("controller.oracle=linear")
    assert J() < 1.05 * linear
    assert J("adaptation.law=kalman") < 1.05 * linear
    # The value without any of these.
    assert J("estimator.kind=none") > 3.0 * linear


@pytest.fixture(scope="module")
def misled() -> Run:
    faults = ["plant.sensors.stuck={y=0.5}", "plant.sensors.dead={rdot=1.0}"]
    return simulate(config("adaptation.law=kalman", *faults), 60)


def test_a_stuck_and_a_dead_sensor_are_named_in_the_log_and_not_learned_from(misled: Run) -> None:
    named = [set(result.sensor_faults) for result in misled.results]
    assert not any(named[:10])
    assert "y" in named[30]
    assert "rdot" in named[23]
    assert named[-1] == {"y", "rdot"}
    lost = [tick.state for tick in misled.ticks if tick.t > 0.99]
    assert all(state is not None and state.missing == ["rdot"] for state in lost)
    # The label of a stuck y would be the motion that the model predicts.
    labels = np.array([sample.h for sample in misled.samples if sample.seq > 12])[:, 1]
    assert np.abs(labels).max() < 0.02 * PLANT.x_scale[1]
    assert np.abs(true(misled)[:, 1] - PLANT.x_e[1]).max() < PLANT.x_scale[1]
    assert all(np.isfinite(sample.variance).all() for sample in misled.samples)


def test_noise_replays_and_is_in_the_summary(misled: Run) -> None:
    assert replay(misled, from_tick=30).equal
    told = summarise(misled).sensor_faults
    assert [text[:14] for text in sorted(told)] == ["sensor rdot is", "sensor y is st"]
    assert simulate(config("controller.oracle=linear"), 5).results[-1].sensor_faults == {}


def test_without_an_estimator_a_sample_with_a_gap_is_no_sample() -> None:
    run = follow(
        config("estimator.kind=none", "plant.sensors.dead={y=0.1}", "controller.oracle=linear"), 6
    ).run
    assert [result.mode for result in run.results][2:] == ["shifted_plan"] * 4
