"""Features in combination, in short lock-step runs: the requirements of each feature hold for all together.

Each case is a plant with a set of features. Each run gets set-points, manual control and a restart. Its log must replay
byte for byte, from the beginning and from the middle. No input may leave U or its rate. A controller that continues
from its memory must handle samples that are lost, late, invalid or of another plant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from controller_node.build import GivenPlant
from controller_node.core import ControllerCore
from lbmpc.plants import Description, Known
from protocol import messages as m
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.run import Run
from tandem import Loop
from tandem.experiments.simulation.faults import Faults
from tests.helpers.paths import ROOT

STEPS = 24
UNBOUNDED = Known.from_matrices(
    [[0.0, 1.0, 0.0], [0.0, -0.3, 0.5], [0.2, 0.0, -1.0]],
    [[0.0, 0.3], [1.0, 0.0], [0.0, 1.0]],
    W=[0.01, 0.2, 0.1],
    x_min=[-1.0, -np.inf, -np.inf],
    x_max=[1.0, np.inf, 2.0],
    u_min=[-2.0, -np.inf],
    u_max=[2.0, np.inf],
    scale={"x2": 2.0, "x3": 2.0, "u2": 3.0},
    x0=[0.6, 0.0, 0.0],
    u_rate_max=[0.7, np.inf],
    dead_time=0.25,
)
SLOW = Known.from_matrices(
    [[0.9, 0.1], [0.0, 1.02]],
    [[0.0], [0.3]],
    period=6.0,
    W=[0.001, 0.002],
    x_min=[-1.0, -1.0],
    x_max=[1.0, 1.0],
    u_min=[-1.0],
    u_max=[1.0],
    x0=[0.5, 0.2],
    dead_time=12.0,
    u_rate_max=[0.02],
)
Built = tuple[Loop, GivenPlant | None]
QUICK = {"compile": "never"}
REAL_TIME = {"compile": "never", "mode": "real_time"}
NOISY = {"noise": 0.01, "dropouts": 0.15}


def compressor() -> Built:
    """The network with a wrong dead time, a filter, a sensor that fails, and real-time iteration."""
    loop = Loop(
        config="compressor",
        train=False,
        controller={"horizon": 10, "keyframe_every": 8, "solver": REAL_TIME, "S": [0.1]},
        plant={
            "dead_time": 0.1,
            "truth": {"dead_time": 0.07},
            "input_rate_max": {"u": 2.0},
            "sensors": {**NOISY, "dead": {"z": 0.6}},
            "x0": [0.49, 1.66, 1.17, 0.0],
        },
        network={"hidden": [4]},
        estimator={"kind": "kalman", "noise": "innovations"},
    )
    return loop, None


def quadrotor() -> Built:
    """Two inputs with rows, one with a rate; a recurrent network; an unmeasured state, and a sensor that sticks."""
    loop = Loop(
        config=ROOT / "examples/quadrotor/quadrotor.toml",
        train=False,
        controller={"horizon": 6, "keyframe_every": 8, "solver": QUICK},
        plant={
            "input_rate_max": {"left": 5.0},
            "rows": {
                "battery": {"left": 1.0, "right": 1.0, "max": 6.0},
                "slow": {"vz": 1.0, "max": 0.2, "priority": 1},
            },
            "sensors": {"noise": 0.01, "stuck": {"z": 0.2}},
            "x0": [0.1, 0.1, 0.0, 0.0, 0.0, 0.0],
        },
        network={"hidden": [4], "architecture": "rnn"},
        estimator={"kind": "kalman", "measured": ["y", "z", "phi"]},
        reference={"outputs": ["y", "z"]},
    )
    return loop, None


def unbounded() -> Built:
    """Unbounded X and U; a dead time of two and a half periods, and gaps without an estimator."""
    loop = Loop(
        UNBOUNDED,
        rate=10.0,
        oracle="constant",
        controller={"horizon": 10, "keyframe_every": 8, "solver": REAL_TIME, "S": [0.1, 0.0]},
        plant={"sensors": {**NOISY, "dead": {"x3": 1.2}}},
    )
    return loop, GivenPlant(UNBOUNDED)


def slow() -> Built:
    """A period of six seconds, a model in discrete time, and a horizon of one."""
    loop = Loop(
        SLOW,
        rate=1.0 / 6.0,
        oracle="l2nw",
        controller={"horizon": 1, "keyframe_every": 8, "solver": QUICK},
        plant={"sensors": NOISY},
        estimator={"kind": "kalman", "measured": ["x1"]},
        reference={"outputs": ["x1"]},
    )
    return loop, GivenPlant(SLOW)


def driven(loop: Loop, seed: int) -> Run:
    """Run the loop with set-points, manual control and other requests at fixed steps; return its run."""
    rng, plant, period = np.random.default_rng(seed), loop.plant, loop.config.period
    loop._lockstep.faults = Faults(command_seconds=0.3 * period)
    near, name = plant.x_e + 0.2 * plant.x_scale, plant.states[0]
    lease = 5 * period if 5 * period <= 60.0 else None
    for k in range(STEPS):
        match k:
            case 2:
                loop.set_point({name: float(near[0])}, over=4 * period)
            case 6:
                loop.manual(plant.u_e + 0.02 * plant.u_scale)
            case 9:
                loop.auto()
            case 11:
                times = np.sort(rng.uniform(0.0, 9.0, 6)) * period
                values = [[float(plant.x_e[0] + 0.1 * plant.x_scale[0] * rng.uniform(-1, 1))] for _ in times]
                points = m.Reference(
                    run_id="x", seq=0, outputs=[name], times=times.tolist(), values=values, lease=lease
                )
                loop.reference(points)
            case 14:
                loop.start_again()
            case 18:
                loop.reference(m.Reference(run_id="x", seq=0, kind="hold", lease=lease))
            case 22:
                loop.reference(None)
        loop.step()
    return loop.result.run


def require_in_u(u: np.ndarray, plant: Description) -> None:
    assert ((u >= plant.u_min - 1e-9) & (u <= plant.u_max + 1e-9)).all()
    assert (plant.input_rows.beyond(u) < 1e-9).all()


def require_inputs(run: Run, plant: Description, period: float) -> None:
    """Assert that every applied input is in U and within its rate of the previous one."""
    step, before, who = plant.input_rates * period * (1.0 + 1e-5), None, ""
    for state in run.plant_states:
        before, who = before if state.run_id == who else None, state.run_id
        told = [piece.u for piece in state.pieces] or ([] if state.applied is None else [state.applied])
        for u in np.array(told):
            require_in_u(u, plant)
            assert before is None or (np.abs(u - before) <= step).all()
            before = u


def wild(tick: m.Tick, plant: Description, rng: np.random.Generator) -> m.Tick:
    """Return the tick with an invalid or an unexpected sample."""
    state = tick.state
    if state is not None:
        far = (10.0 ** rng.uniform(-3, 9, plant.m)).tolist()
        changes: list[dict[str, Any]] = [
            {"seq": max(0, state.seq - int(rng.integers(1, 4)))},
            {"seq": state.seq + int(rng.integers(1, 200))},
            {"seq": m.LARGEST},
            {"run_id": "another"},
            {"x": (10.0 ** rng.uniform(0, 300, plant.d)).tolist()},
            {"missing": [*plant.states]},
            {"applied": far, "pieces": []},
            {"applied": None, "pieces": [m.Piece(seconds=s, u=far) for s in (0.0, 1e-9, 50.0)]},
        ]
        two = changes[rng.integers(8)] | changes[rng.integers(8)]
        state = None if rng.uniform() < 0.2 else msgspec.structs.replace(state, **two)
    skipped = int(rng.choice([0, 1, 10**6]))
    verdict = "missing" if state is None else "fresh"
    return msgspec.structs.replace(tick, state=state, state_verdict=verdict, skipped=skipped)


@pytest.mark.parametrize("build", [compressor, quadrotor, unbounded, slow])
def test_requirements_of_single_features_hold_in_combination(build: Callable[[], Built]) -> None:
    loop, known = build()
    run, plant, period = driven(loop, 1), loop.plant, loop.config.period
    assert {"set", "hold", "configured"} == {tick.reference.kind for tick in run.ticks if tick.reference}
    assert "manual" in {state.source for state in run.plant_states}
    require_inputs(run, plant, period)
    assert summarise(run).J > 0.0
    assert replay(run).first_difference is None
    middle = replay(run, from_tick=17)
    assert middle.equal
    assert middle.first_tick > 0

    before = loop._lockstep.core
    before.memory.restore(run.keyframes[2])
    after = ControllerCore(loop.config, "controller-b", given=known)
    after.memory.go_on(before.memory.lasting(), before.run_id)
    rng = np.random.default_rng(2)
    for tick in run.ticks * 3:
        command = after.step(wild(tick, plant, rng) if rng.uniform() < 0.6 else tick).command
        require_in_u(np.array(command.plan), plant)
    before.memory.restore(after.memory.keyframe(len(run.ticks) - 1))
