"""A reference in the loop, in lock-step: no offset if h_hat is correct at rest, and replay byte for byte."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from controller_node.core import ControllerCore
from lbmpc.plants import get_plant
from node_runtime.config.loading import load, override
from node_runtime.config.sections import Config
from node_runtime.config.shipped import config_file
from protocol import codec, topics
from protocol import messages as m
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.run import Run
from tandem.experiments.simulation.lockstep import simulate
from tandem.summary_table import table

STEPS, EVERY = 180, 25
WRONG = [
    "plant.truth.slope=1.4",
    "plant.x0=[0.4, 1.6, 1.1547, 0.0]",
    f"controller.keyframe_every={EVERY}",
    "controller.solver.compile=never",
    "network.hidden=[16, 16]",
    "trainer.steps=60",
]
TO_Y = ['reference.outputs=["y"]', "reference.values=[1.75]"]


def config(*settings: str) -> Config:
    return load(config_file("compressor-cheap"), [*WRONG, *settings])


def run_of(oracle: str, *settings: str, steps: int = STEPS) -> Run:
    return simulate(config(f"controller.oracle={oracle}", *settings), steps)


@pytest.fixture(scope="module")
def constant() -> Run:
    return run_of("constant", *TO_Y)


def test_an_oracle_that_is_correct_at_rest_has_no_offset(constant: Run) -> None:
    found = summarise(constant)
    assert found.offset["y"] < 0.002
    assert (found.unreached_ticks, found.constraint_violations, found.fallback_ticks) == (0, 0, 0)
    assert summarise(run_of("dnn", *TO_Y)).offset["y"] < 0.002
    # The linear oracle assumes h = 0, so its target is no rest of the plant.
    assert summarise(run_of("linear", *TO_Y)).offset["y"] > 0.1


def test_the_rest_of_least_cost_is_better_than_a_point_without_rest() -> None:
    rest, equilibrium = (
        summarise(run_of("perfect", *reference, "controller.Q=[1.0, 1.0, 1.0, 1.0]", "controller.R=[1.0]"))
        for reference in (["reference.outputs=[]"], [])
    )
    assert rest.J < 0.95 * equilibrium.J
    assert (rest.offset, rest.target_distance, equilibrium.target_distance) == ({}, 0.0, None)


def test_every_command_is_replayed_also_from_the_middle(constant: Run) -> None:
    assert replay(constant).equal
    later = replay(constant, from_tick=60)
    assert later.equal
    assert later.first_tick == 50


def test_the_real_time_iteration_follows_and_replays_with_and_without_preparation() -> None:
    run = run_of("constant", *TO_Y, "controller.solver.mode=real_time")
    assert sum(result.status == "real-time iteration" for result in run.results) > STEPS - 5
    assert summarise(run).offset["y"] < 0.002
    assert replay(run, from_tick=60).equal
    core = ControllerCore(run.config, run.commands[0].run_id)
    for tick, result, entry in zip(run.ticks, run.results, run.entries(topics.COMMAND), strict=True):
        outputs = core.step(tick)
        assert codec.encode(outputs.command) == entry.payload
        assert outputs.result == result
        core.prepare()


def test_ticks_contain_the_target_and_keyframes_the_start_of_the_search(constant: Run) -> None:
    last = constant.results[-1]
    assert last.target_status == "reached"
    assert last.target_x[1] == pytest.approx(1.75, abs=1e-6)
    np.testing.assert_allclose(last.x, last.target_x, atol=2e-3)
    assert abs(last.x[0] - 0.5) > 0.1
    off = np.array(last.target_x) - get_plant("moore_greitzer").x_e
    np.testing.assert_allclose(constant.keyframes[-1].arrays["target"].numpy()[:4], off, atol=1e-15)


def test_an_unreachable_reference_is_only_counted() -> None:
    run = run_of("constant", 'reference.outputs=["y"]', "reference.values=[2.1875]", steps=60)
    found = summarise(run)
    assert found.unreached_ticks == 60
    assert {result.target_status for result in run.results} == {"nearest"}
    assert found.target_distance is not None
    assert found.target_distance > 5e-4
    assert (found.constraint_violations, found.fallback_ticks) == (0, 0)


def test_the_table_contains_an_existing_reference(constant: Run) -> None:
    named, without = (
        set(table(summarise(run)).columns[0].cells) for run in (constant, run_of("constant", steps=3))
    )
    assert named - without == {"unreached_ticks", "target_distance", "offset"}
    assert without < named


def test_without_a_reference_nothing_is_published_or_stored() -> None:
    core = ControllerCore(config("controller.oracle=constant"), "c-1")
    assert "target" not in core.memory.keyframe(-1).arrays
    state = m.PlantState(
        run_id="p-1", seq=0, t=0.0, x=[0.4, 1.6, 1.1547, 0.0], applied=None, source="hold", command_seq=-1
    )
    tick = m.Tick(
        run_id="c-1", seq=0, slot=0, t=0.0, skipped=0, lateness=0.0, late=False, state_verdict="fresh",
        state=state, weights=None,
    )  # fmt: skip
    result = core.step(tick).result
    assert (result.target_status, result.target_x, result.target_distance) == ("none", [], None)


def test_a_memory_without_a_reference_can_be_restored() -> None:
    before = ControllerCore(config("controller.oracle=constant"), "c-1")
    after = ControllerCore(config("controller.oracle=constant", *TO_Y), "c-2")
    assert after.memory.belongs() == before.memory.belongs()
    after.memory.go_on(before.memory.lasting(), "c-1")
    assert after.memory.keyframe(-1).arrays["target"].shape == [5]


def test_without_a_state_or_a_plan_the_input_is_that_of_the_target(constant: Run) -> None:
    keyframe = next(k for k in constant.keyframes if k.seq == 49)
    core = ControllerCore(constant.config, constant.commands[0].run_id)
    spent = {**keyframe.arrays, "plan.left": m.Array.of(np.zeros(1), "<i8")}
    core.memory.restore(msgspec.structs.replace(keyframe, arrays=spent))
    tick = msgspec.structs.replace(constant.ticks[50], state=None, state_verdict="missing")
    outputs = core.step(tick)
    assert outputs.result.mode == "feedback"
    np.testing.assert_array_equal(outputs.command.plan, [outputs.result.target_u] * 20)
    assert abs(outputs.result.target_u[0] - core.plant.u_e[0]) > 0.01


def test_the_backup_policy_leads_to_the_reference(constant: Run) -> None:
    core = ControllerCore(constant.config, constant.commands[0].run_id)
    for tick in constant.ticks:
        outputs = core.step(tick)
    backup = core.backup(outputs.command)
    assert backup is not None
    x = np.array(outputs.result.target_x)
    held = np.array(backup.inputs) + np.array(backup.gain) @ x
    np.testing.assert_allclose(held, [outputs.result.target_u] * len(held), atol=5e-3)


def test_the_configuration_in_the_log_contains_the_reference(constant: Run) -> None:
    assert constant.config.reference.values == [1.75]
    assert override(constant.config, ["reference.values=[1.7]"]).reference.outputs == ["y"]
