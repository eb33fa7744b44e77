"""`tandem.Loop`: lock-step runs in Python, complete or step by step, also with an external plant."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lbmpc.plants import Truth, get_plant
from node_runtime.config.loading import load
from node_runtime.config.strict import ConfigError
from protocol import topics
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.run import Run, equations_of, true_plant_of
from tandem import Loop
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.interpreter import imported
from tests.helpers.paths import DOCS

PAGE = DOCS / "tutorials/python.md"
PLANT = get_plant("moore_greitzer")
QUICK: dict[str, Any] = {
    "oracle": "dnn",
    "controller": {"horizon": 15, "solver": {"compile": "never"}},
    "network": {"hidden": [8, 8]},
    "trainer": {"steps": 20},
    "seed": 3,
}
AS_SET = [
    "controller.horizon=15",
    "controller.solver.compile=never",
    "network.hidden=[8, 8]",
    "trainer.steps=20",
    "seed=3",
]
STEPS = 30


class Simulator:
    """A user's own simulator of the same plant."""

    def __init__(self, fails_after: int = 10_000):
        self.motion, self.left = Truth(PLANT), fails_after

    def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
        self.left -= 1
        if self.left < 0:
            raise RuntimeError("the mesh is torn")
        return self.motion.step(x, u, dt)


def payloads(run: Run) -> dict[str, list[bytes]]:
    """Return the payloads that do not depend on the clock."""
    return {
        topic.name: [entry.payload for entry in run.entries(topic)]
        for topic in topics.ALL
        if topic is not topics.TIMING
    }


@pytest.fixture(scope="module")
def simulated() -> Run:
    return simulate(load(None, AS_SET), STEPS)


def test_a_loop_equals_tandem_simulate_to_the_bit(simulated: Run) -> None:
    assert any(result.weights_outcome == "adopted" for result in simulated.results)
    result = Loop(**QUICK).run(STEPS)
    assert result.lost is None
    assert payloads(result.run) == payloads(simulated)


def test_a_loop_can_continue_after_its_result_was_read(simulated: Run) -> None:
    loop = Loop(**QUICK)
    loop.run(10)
    step = loop.step()
    assert (step.t, step.result.seq) == (pytest.approx(10 * 0.05), 10)
    assert loop.result.x.shape == (12, 4)
    assert payloads(loop.run(STEPS - 11).run) == payloads(simulated)


def test_steps_and_arrays_agree() -> None:
    loop = Loop(PLANT, **QUICK)
    steps = [loop.step() for _ in range(STEPS)]
    result = loop.result
    np.testing.assert_array_equal([step.x for step in steps], result.x[:-1])
    np.testing.assert_array_equal([step.u for step in steps], result.u)
    np.testing.assert_allclose([step.t for step in steps], result.t)
    assert result.h.shape == result.h_hat.shape == (STEPS, 4)
    assert np.isnan(result.h[0]).all()
    model = loop.plant
    assert model.states == PLANT.states
    x, u = result.x[4] - model.x_e, result.u[4] - model.u_e
    core = loop._lockstep.core.controller.model
    np.testing.assert_allclose(result.h[5], result.x[5] - model.x_e - core.A @ x - core.B @ u, atol=1e-12)
    assert (result.solve_ms > 0).all()
    assert result.summary.ticks == STEPS


def test_a_plant_that_moves_elsewhere_gets_the_same_inputs_and_labels(simulated: Run) -> None:
    loop, truth, x = Loop(**QUICK), Truth(PLANT), PLANT.x0
    for _ in range(STEPS):
        u = loop.control(x)
        x = truth.step(x, u, 0.05)
    ours, theirs = payloads(loop.result.run), payloads(simulated)
    # The state after the last input is not reported yet.
    theirs[topics.PLANT_STATE.name].pop()
    assert ours == theirs


def test_an_invalid_state_changes_nothing() -> None:
    loop, other = (Loop(oracle="linear", config="compressor") for _ in range(2))
    loop.control(PLANT.x0)
    for bad in ([1.0, 2.0], [np.nan, 0, 0, 0], 3.0):
        with pytest.raises(
            ValueError, match=r"is not a state of moore_greitzer: give 4 finite numbers \(z, y, r, rdot\)"
        ):
            loop.control(bad)
    other.control(PLANT.x0)
    np.testing.assert_array_equal(loop.control(PLANT.x0 + 0.01), other.control(PLANT.x0 + 0.01))


def test_another_episode_begins_with_the_memory_and_without_a_label() -> None:
    loop = Loop(**QUICK)
    loop.run(10)
    learned = loop.result.run.output_weights[-1].K.numpy()
    loop.start_again()
    step = loop.step()
    np.testing.assert_array_equal(step.x, PLANT.x0)
    assert step.result.h is None
    np.testing.assert_array_equal(loop.result.run.output_weights[-1].K.numpy(), learned)
    # Manual control too, from any state.
    loop.start_again()
    loop.control(PLANT.x_e + 0.01)
    assert loop.result.run.results[-1].h is None
    assert loop.result.run.plant_states[-1].x == (PLANT.x_e + 0.01).tolist()


@pytest.mark.parametrize("truth", [Simulator(), PLANT])
def test_objects_are_true_as_well(truth: object, simulated: Run) -> None:
    ours, theirs = payloads(Loop(truth=truth, **QUICK).run(STEPS).run), payloads(simulated)
    # The controller's run info contains the name of its truth.
    del ours[topics.RUN_INFO["controller"].name], theirs[topics.RUN_INFO["controller"].name]
    assert ours == theirs


def test_a_log_names_a_different_truth_and_does_not_use_a_plant_of_the_same_name(tmp_path: Path) -> None:
    result = Loop(truth=Simulator(), **QUICK).run(STEPS)
    assert result.run.config.plant.truth == "Loop:Simulator"
    assert true_plant_of(read_run(result.save(tmp_path / "run.mcap"))) is None
    faster = {"rhs": lambda x, u: [1.1 * dx for dx in PLANT.rhs(x, u)], "parameters": {}, "equations": None}
    namesake = replace(PLANT, **faster)
    result = Loop(namesake, **QUICK).run(STEPS)
    log = read_run(result.save(tmp_path / "namesake.mcap"))
    assert replay(log).equal
    assert equations_of(log, log.config) is None


def test_other_parameters_are_those_of_the_configuration() -> None:
    run = simulate(load(None, [*AS_SET, "plant.truth.beta=1.3"]), STEPS)
    assert payloads(Loop(truth={"beta": 1.3}, **QUICK).run(STEPS).run) == payloads(run)


def test_a_simulator_that_fails_ends_the_run_with_its_cause() -> None:
    result = Loop(truth=Simulator(fails_after=7), **QUICK).run(STEPS)
    assert result.lost == "at step 8: Simulator.step: RuntimeError: the mesh is torn"
    assert result.u.shape == (8, 1)


def test_a_plant_that_was_lost_can_be_started_again() -> None:
    simulator = Simulator(fails_after=3)
    loop = Loop(truth=simulator, **QUICK)
    assert loop.run(10).lost is not None
    loop.start_again()
    simulator.left = 100
    result = loop.run(5)
    assert result.lost is None
    assert result.u.shape == (9, 1)
    assert replay(result.run).equal


def test_matrices_and_a_simulator_are_enough(tmp_path: Path) -> None:
    # The plant of docs/tutorials/python.md.
    (block,) = re.findall(r"matrices\n\n```python\n(.*?)result = Loop\(cart", PAGE.read_text(), re.DOTALL)
    names: dict[str, Any] = {}
    exec(block, names)

    class Cart:
        def step(self, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
            force = u[0] - 0.3 * x[1]
            return np.array([x[0] + dt * x[1] + 0.5 * dt**2 * force, x[1] + dt * force])

    loop = Loop(names["cart"], truth=Cart(), oracle="constant", controller={"solver": {"compile": "never"}})
    result = loop.run(150)
    assert np.abs(result.x[-1]).max() < 0.01
    assert result.summary.constraint_violations == 0
    log = result.save(tmp_path / "cart.mcap")
    found = replay(read_run(log))
    assert found.equal
    assert found.ticks == 150


def test_a_loop_is_drawn_and_saved_as_any_run(tmp_path: Path) -> None:
    result = Loop(**QUICK).run(STEPS)
    result.plot().savefig(tmp_path / "run.png")
    assert replay(read_run(result.save(tmp_path / "run.mcap"))).equal


@pytest.mark.parametrize("before", ["plant.sensors.noise=0.02", "plant.sensors.noise={y=0.02}", "seed=3"])
def test_a_table_of_names_replaces_the_old_table(before: str) -> None:
    config = load(None, [before, "plant.sensors.dropouts=0.1", "controller.solver.compile=never"])
    sensors = Loop(
        oracle="linear", config=config, plant={"sensors": {"noise": {"z": 0.01}}}
    ).config.plant.sensors
    assert (sensors.noise, sensors.dropouts) == ({"z": 0.01}, 0.1)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"oracle": "dmm"}, "Loop(oracle=): controller.oracle = 'dmm' is not one of constant, dnn"),
        (
            {"controller": {"horizn": 3}},
            "Loop: unknown key 'controller.horizn'; did you mean 'controller.horizon'?",
        ),
        ({"orcale": "dnn"}, "Loop: unknown argument 'orcale'; did you mean 'oracle'?"),
        ({"controller": 3}, "controller = 3 is a table"),
        ({"rate": "fast"}, "rate = 'fast' is not a number"),
        ({"config": "compresor"}, "did you mean 'compressor'?"),
        ({"known": "gru.py:X"}, "gru.py: no such file"),
        ({"known": "compressor"}, "no plant is called 'compressor'"),
        ({"truth": {"B": 1.0}}, "moore_greitzer has no parameter 'B'"),
        ({"truth": 3}, "truth: int is neither a plant nor an object with step(x, u, dt)"),
    ],
)
def test_a_mistake_is_reported_as_in_a_configuration(given: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        Loop(**given)
    assert said in str(error.value)


def test_packages_of_unused_formats_need_not_be_installed() -> None:
    code = (
        "from tandem import Loop\n"
        "Loop(oracle='dnn', train=False, controller={'solver': {'compile': 'never'}, 'horizon': 5}).run(2).summary"
    )
    assert not imported(code) & {"torch", "matplotlib", "mcap", "zstandard"}
