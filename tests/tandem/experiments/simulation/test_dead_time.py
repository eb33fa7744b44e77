"""A dead time in the whole loop: its cost if it is declared, labels without bias, and a replay of the log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.build import GivenPlant, build_model
from controller_node.core import ControllerCore
from controller_node.guarantee import guarantee
from lbmpc.plants import Known, get_plant, get_truth
from node_runtime.config.loading import load
from node_runtime.config.plant import plant_of, spelt_out, true_dead_time, true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from run_log.reading.transitions import observed
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.run import Run
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import LockStep, drive, follow, simulate
from tests.helpers.paths import ROOT

FROM_NEAR = ["plant.x0=[0.4, 1.6, 1.1547, 0.0]", "controller.horizon=20", "controller.solver.compile=never"]
LATE = Faults(command_seconds=0.4)


def compressor(*more: str) -> Config:
    return load("compressor", [*FROM_NEAR, *more])


def tanks(*more: str) -> Config:
    """Wrong tanks with a dead time of one and a half periods, noise and lost samples."""
    settings = ["controller.solver.compile=never", "controller.keyframe_every=20", "plant.dead_time=7.5"]
    noisy = ["plant.sensors.noise=0.003", "estimator.kind=kalman", "plant.sensors.dropouts=0.08"]
    small = [
        "network.hidden=[6]",
        "network.architecture=rnn",
        "trainer.enabled=false",
        "controller.horizon=12",
    ]
    real_time = "controller.solver.mode=real_time"
    return load(ROOT / "examples/tanks/tanks.toml", [*settings, *noisy, *small, real_time, *more])


@pytest.fixture(scope="module")
def lossy() -> Run:
    return follow(tanks(), 55, LATE).run


def test_it_replays_byte_for_byte_from_the_beginning_and_from_the_middle(lossy: Run) -> None:
    assert 2 <= sum(tick.state is None for tick in lossy.ticks) <= 15
    assert {"line.written", "line.commanded", "line.sample"} <= lossy.keyframes[0].arrays.keys()
    assert replay(lossy).equal
    middle = replay(lossy, from_tick=45)
    assert middle.equal
    assert middle.first_tick > 20


def test_a_controller_with_the_memory_of_another_process_fills_its_line_again(lossy: Run) -> None:
    core, again = ControllerCore(tanks(), "controller-a"), ControllerCore(tanks(), "controller-b")
    core.memory.restore(lossy.keyframes[2])
    lasting = core.memory.lasting()
    # Inputs that were written while the controller was down are not known.
    assert not any(name.startswith("line.") for name in lasting)
    again.memory.go_on(lasting, "controller-a")
    assert again.memory.belongs()["dead time"] == "7.5 s"
    labelled = []
    for tick in lossy.ticks[40:]:
        core.step(tick)
        labelled.append(again.step(tick).sample is not None)
    assert not any(labelled[:2])
    assert sum(labelled) >= 6
    there, here = core.memory.state.line["written"], again.memory.state.line["written"]
    np.testing.assert_allclose(here, there, rtol=1e-12, atol=1e-15)


def moved(known: Known, *more: str) -> Run:
    """Run a linear plant that is its own truth, with late commands and lost samples."""
    settings = [
        "rate=20",
        "controller.oracle=linear",
        "controller.solver.compile=never",
        "controller.horizon=10",
    ]
    config = load(None, [*settings, "trainer.enabled=false", "plant.sensors.dropouts=0.05", *more])
    given = GivenPlant(known, truth=known)
    return drive(LockStep(config, Faults(command_seconds=0.013), given), 60).run


CART = Known.from_matrices(
    [[0.0, 1.0], [0.0, -0.3]],
    [[0.0], [1.0]],
    W=[0.01, 0.2],
    x_min=[-1.0, -2.0],
    x_max=[1.0, 2.0],
    u_min=[-2.0],
    u_max=[2.0],
    x0=[0.6, 0.0],
)


@pytest.mark.parametrize("dead_time", [0.1, 0.125, 0.031])
def test_labels_of_a_plant_that_is_as_known_are_zero(dead_time: float) -> None:
    run = moved(replace(CART, dead_time=dead_time))
    h = np.array([result.h for result in run.results if result.h is not None])
    assert len(h) > 35
    assert np.abs(h).max() < 1e-12
    # The same holds for the fit of `tandem identify`.
    model = build_model(run.config, GivenPlant(replace(CART, dead_time=dead_time)))
    found = observed(run, model)
    np.testing.assert_allclose(found.missed, 0.0, atol=1e-12)
    # It does not hold if the dead time is not declared.
    hidden = moved(CART, f"plant.truth.dead_time={dead_time}")
    assert max(np.abs(result.h).max() for result in hidden.results if result.h) > 1e-3


def test_two_declared_periods_cost_little_and_undeclared_ones_much() -> None:
    def J(*more: str) -> float:
        found = summarise(simulate(compressor("controller.oracle=linear", *more), 120))
        # Between samples the true motion follows from the applied input.
        assert found.excess_between_samples == 0.0
        return found.J

    none, declared, hidden = J(), J("plant.dead_time=0.1"), J("plant.truth.dead_time=0.1")
    assert none < declared < 1.15 * none
    assert hidden > 1.15 * none


def test_settings_of_the_configuration_for_it() -> None:
    def known(config: Config) -> float:
        return plant_of(config, get_plant).dead_time

    def truth(config: Config) -> float:
        true = true_plant_of(config, get_plant, get_truth)
        return true_dead_time(config, plant_of(config, get_plant), true)

    both, wrong = compressor("plant.dead_time=0.1"), compressor("plant.truth={dead_time = 0.2, slope = 1.4}")
    assert (known(both), truth(both)) == (0.1, 0.1)
    assert (known(wrong), truth(wrong)) == (0.0, 0.2)
    exact = compressor("plant.dead_time=0.1", "plant.truth.dead_time=0")
    assert (known(exact), truth(exact)) == (0.1, 0.0)
    assert spelt_out(both, plant_of(both, get_plant)).plant.dead_time == 0.1
    for seconds in ("-0.1", "9.0"):
        with pytest.raises(ConfigError, match=r"plant\.truth\.dead_time"):
            compressor(f"plant.truth.dead_time={seconds}")
    with pytest.raises(ConfigError, match=r"plant\.dead_time"):
        compressor("plant.dead_time=-1")
    with pytest.raises(ConfigError, match="at most 50"):
        build_model(compressor("plant.dead_time=9"))
    invariant = compressor("plant.dead_time=0.1", "controller.tightening=invariant")
    with pytest.raises(ConfigError, match=r"certified sets .* dead time of 0\.1 s"):
        ControllerCore(invariant, "controller-a")
    assert guarantee(both, build_model(both)).startswith("guaranteed: nothing; first_step")


def test_guarantees_do_not_hold_for_an_estimate() -> None:
    exact, estimated = compressor(), compressor("estimator.kind=kalman")
    said = guarantee(exact, build_model(exact))
    assert "estimate" not in said
    assert guarantee(estimated, build_model(estimated)).startswith(said)
    assert "nothing is guaranteed for the true state" in guarantee(estimated, build_model(estimated))
