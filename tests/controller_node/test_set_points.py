"""Set-points while the loop runs, in lock-step: reached, previewed, refused, leased, held, replayed and stored."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from controller_node.asked import RefusedReference, change_of
from controller_node.core import ControllerCore
from lbmpc.plants import get_plant
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.shipped import config_file
from protocol import codec, topics
from protocol import messages as m
from run_log.replaying.replay import replay
from run_log.reporting.traces import traces
from run_log.run import Run
from tandem.experiments.simulation.lockstep import LockStep
from tandem.loop import Loop
from tandem.operating.set_points import set_point, trajectory

PLANT = get_plant("moore_greitzer")
HALF = 0.5
STEPS = trajectory([0.0, 5.5, 5.5], {"y": [1.65, 1.65, 1.7]})
SETTINGS = [
    "plant.truth.slope=1.4",
    "plant.x0=[0.4, 1.6, 1.1547, 0.0]",
    "controller.keyframe_every=25",
    "controller.solver.compile=never",
    "controller.oracle=constant",
    "trainer.enabled=false",
]


def config(*settings: str) -> Config:
    return load(config_file("compressor-cheap"), [*SETTINGS, *settings])


def run_of(asked: dict[int, m.Reference], steps: int, *settings: str) -> Run:
    """Run with requests before the given steps."""
    loop = LockStep(config(*settings))
    for step in range(steps):
        if step in asked:
            loop.ask(asked[step])
        loop.step()
    return loop.so_far()


def off(run: Run) -> np.ndarray:
    """Return |y - r| of each tick, relative to the half-width."""
    return np.array([abs(result.x[1] - result.reference["y"]) / HALF for result in run.results])


@pytest.fixture(scope="module")
def steps() -> Run:
    return run_of({0: STEPS}, 220)


def test_each_set_point_is_reached(steps: Run) -> None:
    off_by = off(steps)
    assert off_by[90] < 0.005
    assert off_by[219] < 0.002
    assert {result.target_status for result in steps.results} == {"reached"}
    assert [result.reference["y"] for result in steps.results][108:112] == pytest.approx(
        [1.65] * 2 + [1.7] * 2
    )
    assert (steps.results[0].reference_verdict, steps.results[1].reference_verdict) == ("taken", "none")


def test_every_command_is_replayed_also_from_the_middle(steps: Run) -> None:
    assert replay(steps).equal
    later = replay(steps, from_tick=60)
    assert (later.equal, later.first_tick) == (True, 50)


def test_a_change_does_not_move_the_origin(steps: Run) -> None:
    """Every period has a label, including the period of the change."""
    assert [entry.message.seq for entry in steps.entries(topics.SAMPLES)] == [*range(219)]


def test_a_report_contains_the_references(steps: Run) -> None:
    r = traces(steps).reference
    assert r.shape == (220, 4)
    assert r[219, 1] == pytest.approx(1.7)
    assert np.isnan(r[:, [0, 2, 3]]).all()


def test_preview_halves_the_error_on_a_ramp() -> None:
    """Without preview each period has only the present value."""
    times, y = [0.0, 3.0, 6.0], [1.65, 1.65, 1.75]
    blind = {step: set_point({"y": float(np.interp(step * 0.05, times, y))}) for step in range(120)}
    with_preview, without = (
        off(run_of(one, 120))[60:].mean() for one in ({0: trajectory(times, {"y": y})}, blind)
    )
    assert with_preview < 0.5 * without


def test_the_real_time_iteration_follows_and_replays_with_and_without_preparation() -> None:
    run = run_of({0: STEPS}, 120, "controller.solver.mode=real_time")
    assert off(run)[90] < 0.005
    assert replay(run, from_tick=60).equal
    core = ControllerCore(run.config, run.commands[0].run_id)
    for tick, entry in zip(run.ticks, run.entries(topics.COMMAND), strict=True):
        assert codec.encode(core.step(tick).command) == entry.payload
        core.prepare()


def test_after_the_lease_the_configured_reference_applies() -> None:
    to_y = ('reference.outputs=["y"]', "reference.values=[1.6]")
    run = run_of({5: set_point({"y": 1.7}, lease=0.5)}, 20, *to_y)
    values = [result.reference["y"] for result in run.results]
    np.testing.assert_allclose(values, [1.6] * 5 + [1.7] * 10 + [1.6] * 5)
    none = run_of({5: set_point({"y": 1.7}, lease=0.5)}, 20)
    assert [result.target_status for result in none.results] == ["none"] * 5 + ["reached"] * 10 + ["none"] * 5
    assert replay(none, from_tick=12).equal
    said = run_of({5: set_point({"y": 1.7}), 10: m.Reference(run_id="x", seq=0, kind="configured")}, 12)
    assert [result.target_status for result in said.results][9:] == ["reached", "none", "none"]
    assert "reference.times" not in said.keyframes[-1].arrays


def test_a_pause_holds_the_plant_where_it_is() -> None:
    hold = m.Reference(run_id="x", seq=0, kind="hold", lease=30.0)
    run = run_of({10: hold}, 110, 'reference.outputs=["y"]')
    assert run.results[9].reference == pytest.approx({"y": PLANT.x_e[1]})
    held = run.results[10].x[1]
    assert abs(held - PLANT.x_e[1]) > 0.05
    np.testing.assert_allclose([result.reference["y"] for result in run.results[10:]], held)
    assert off(run)[-1] < 0.01


def test_without_configured_outputs_a_pause_holds_the_performance_states() -> None:
    run = run_of({3: m.Reference(run_id="x", seq=0, kind="hold")}, 5)
    assert run.results[3].reference == pytest.approx({"z": run.results[3].x[0], "y": run.results[3].x[1]})


def asked(**changes: Any) -> m.Reference:
    return msgspec.structs.replace(
        m.Reference(run_id="c-1", seq=0, outputs=["y"], times=[1.0], values=[[1.7]]), **changes
    )


ABSURD = {
    "no state": asked(outputs=["x"]),
    "named once": asked(outputs=["y", "y"], values=[[1.7, 1.7]]),
    "at least one": asked(outputs=[], values=[[]]),
    "1 times and 0 values": asked(values=[]),
    "0 times and 0 values": asked(times=[], values=[]),
    "one number for each output": asked(values=[[1.7, 1.8]]),
    "finite": asked(values=[[float("nan")]]),
    "finite numbers": asked(times=[float("inf")]),
    "5 s ago": asked(times=[-5.0]),
    "times fall": asked(times=[1.0, 0.5], values=[[1.7], [1.8]]),
    "it ends in": asked(times=[1e7]),
    "y = 3 is outside X: 1.1875 to 2.1875": asked(values=[[3.0]]),
    "y = -1e+308 is outside X": asked(values=[[-1e308]]),
    "hold has no outputs": asked(kind="hold"),
    "configured has no outputs": asked(kind="configured"),
}


@pytest.mark.parametrize("reason", ABSURD)
def test_an_invalid_reference_is_refused_with_the_reason(reason: str) -> None:
    with pytest.raises(RefusedReference) as refused:
        change_of(ABSURD[reason], PLANT, 0.05)
    assert reason in str(refused.value)


def test_a_refused_reference_does_not_affect_the_loop(steps: Run) -> None:
    """Commands, keyframes and results are bit for bit the same except for the verdict."""
    run = run_of({0: STEPS} | dict(enumerate(ABSURD.values(), 20)), 60)
    for topic in (topics.COMMAND, topics.KEYFRAME, topics.SAMPLES):
        at, other = ([e.payload for e in one.entries(topic) if e.message.seq < 60] for one in (run, steps))
        assert at[:-1] == other[: len(at) - 1]
    verdicts = [result.reference_verdict for result in run.results[20 : 20 + len(ABSURD)]]
    assert [verdict.partition(": ")[0] for verdict in verdicts] == ["refused"] * len(ABSURD)
    assert replay(run).equal


def test_an_unreachable_set_point_gives_the_nearest_rest_and_its_distance() -> None:
    run = run_of({0: set_point({"y": 2.1875})}, 40)
    assert {result.target_status for result in run.results} == {"nearest"}
    assert (run.results[-1].target_distance or 0.0) > 0.01
    assert {result.mode for result in run.results} == {"solver"}


def test_the_memory_contains_a_given_reference_and_can_be_continued(steps: Run) -> None:
    fresh = ControllerCore(config(), "c-2")
    assert not [name for name in fresh.memory.keyframe(-1).arrays if name.startswith(("reference", "target"))]
    before = ControllerCore(config(), steps.commands[0].run_id)
    for tick in steps.ticks[:60]:
        before.step(tick)
    fresh.memory.go_on(before.memory.lasting(), "c-1")
    state = fresh.memory.state.reference
    assert state is not None
    assert state.passed == 60
    result = fresh.step(msgspec.structs.replace(steps.ticks[60], run_id="c-2")).result
    assert result.reference == pytest.approx({"y": 1.65})
    # A memory without a reference can be restored afterwards.
    fresh.memory.restore(ControllerCore(config(), "c-3").memory.keyframe(-1))
    assert fresh.memory.state.reference is None


@pytest.mark.parametrize("name", ["reference.times", "reference.count", "reference.more"])
def test_a_keyframe_with_an_invalid_reference_is_refused(steps: Run, name: str) -> None:
    core = ControllerCore(config(), "c-1")
    good = next(frame for frame in steps.keyframes if frame.seq == 49)
    bad = msgspec.structs.replace(good, arrays={**good.arrays, name: m.Array.of(np.array([2.0, 1.0, 0.0]))})
    with pytest.raises(ValueError, match=name.partition(".")[2]):
        core.memory.restore(bad)
    core.memory.restore(good)


def test_skipped_periods_advance_the_reference(steps: Run) -> None:
    core = ControllerCore(config(), steps.commands[0].run_id)
    core.step(steps.ticks[0])
    core.step(msgspec.structs.replace(steps.ticks[1], skipped=108))
    assert core.memory.state.reference is not None
    assert core.memory.state.reference.passed == 110
    assert core.step(steps.ticks[2]).result.reference == pytest.approx({"y": 1.7})


def test_the_plan_and_the_policy_follow_the_preview_without_a_controller() -> None:
    """The backup policy uses the preview, so it leads to the future reference and not to the past one."""
    loop = LockStep(config("plant.x0=[0.44, 1.65, 1.11, 0.0]"))
    loop.ask(trajectory([0.0, 1.0], {"y": [1.65, 1.75]}))
    for _ in range(8):
        _, outputs = loop.step()
    controller, state = loop.core.controller, loop.core.memory.state
    planner, theta, d = loop.core._planner(), controller.oracle.theta(state.oracle), PLANT.d
    onward = controller.backup(planner, state)
    stays = planner.policy(
        state.predicted, theta, state.plan.u, state.target[None, :d], state.target[None, d:]
    )
    assert onward is not None
    assert stays is not None
    assert outputs.result.reference["y"] == pytest.approx(1.685)
    assert onward.states[-1, 1] > stays.states[-1, 1] + 0.01


def test_the_python_interface_accepts_set_points() -> None:
    loop = Loop(oracle="constant", config=config())
    loop.set_point({"y": 1.7}, over=0.2)
    reached = [loop.step().result.reference["y"] for _ in range(6)]
    assert reached == pytest.approx(
        [PLANT.x_e[1] + share * (1.7 - PLANT.x_e[1]) for share in (0, 0.25, 0.5, 0.75, 1, 1)]
    )
    with pytest.raises(ValueError, match="outside X"):
        loop.set_point({"y": 5.0})
    loop.reference(None)
    assert loop.step().result.reference == {}
    assert replay(loop.result.run).equal
