"""The rate limit at a gateway, for every source of inputs at any time."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from lbmpc.plants import Known
from node_runtime.config.sections import Config
from plant_sim.shield import Shield
from plant_sim.way_back import way_back_of
from protocol import messages as m
from tests.plant_sim.commands import PERIOD, PLANT, U, planned
from tests.plant_sim.test_shield import Bench

RATE = 2.0
STEP = RATE * PERIOD
LIMITED = {"u_rate_max": [RATE], "safe_gain": None}


def largest_within_a_period(writes: list[tuple[float, float]]) -> float:
    """Return the largest difference of inputs within one period, including the safe one before the first write."""
    acted = [(-np.inf, U), *writes]
    largest = 0.0
    for i, (t, u) in enumerate(acted):
        for (_began, older), (ended, _after) in pairwise(acted[: i + 1]):
            if t - ended < (1.0 - 1e-6) * PERIOD:
                largest = max(largest, abs(u - older))
    return largest


@pytest.mark.parametrize("seed", range(12))
def test_it_holds_for_every_source_at_any_time(seed: int) -> None:
    """Commands are early, late, in bursts or absent; with backup policies, a safe feedback and failed writes."""
    rng, bench = np.random.default_rng(seed), Bench(u_rate_max=[RATE])
    applied, sources, silent = [], set(), 0
    for k in range(80):
        bench.x = PLANT.x_e + rng.uniform(-0.3, 0.3, 4) * PLANT.x_scale
        bench.fails = seed % 3 == 0 and rng.random() < 0.1
        state = bench.sampled(k)
        sources.add(state.source)
        applied.append(np.nan if state.applied is None else state.applied[0])
        silent = silent - 1 if silent else int(rng.integers(1, 12)) * int(rng.random() < 0.15)
        for at in np.sort(rng.uniform(k + 0.05, k + 0.95, 0 if silent else int(rng.integers(1, 4)))):
            bench.act_until(at * PERIOD)
            bench.command(k, at, float(rng.uniform(*PLANT.u_min, *PLANT.u_max)))
        if not silent and rng.random() < 0.5:
            bench.backup(k, rng.uniform(PLANT.u_min[0], PLANT.u_max[0], 5).tolist(), gain=0.5)
        bench.act_until((k + 1) * PERIOD)
    if seed % 3:
        assert largest_within_a_period(bench.writes) <= STEP * (1 + 1e-5)
        differences = np.abs(np.diff(applied))
        assert np.nanmax(differences) <= STEP * (1 + 1e-5)
        assert np.nanmax(differences) > 0.9 * STEP
    assert all(PLANT.u_min[0] <= u <= PLANT.u_max[0] for _t, u in bench.writes)
    assert sources == {"hold", "command", "plan", "safe"}


def test_an_early_command_is_delayed_without_loss() -> None:
    bench = Bench(**LIMITED)
    bench.sample(0)
    bench.command(0, 0.3, U + STEP)
    bench.sample(1)
    # The command is a twentieth of a period early, so the input before the last is less than a period old.
    bench.command(1, 1.25, U + 2 * STEP)
    assert bench.writes[-1] == (pytest.approx(1.25 * PERIOD), pytest.approx(U + STEP))
    assert bench.shield.due == pytest.approx(1.3 * PERIOD)
    bench.act_until(1.5 * PERIOD)
    assert bench.writes[-1] == (pytest.approx(1.3 * PERIOD), pytest.approx(U + 2 * STEP))
    # A late command acts at once.
    bench.sample(2)
    bench.command(2, 2.6, U + 3 * STEP)
    assert bench.writes[-1] == (pytest.approx(2.6 * PERIOD), pytest.approx(U + 3 * STEP))


def test_the_safe_input_is_approached_period_by_period() -> None:
    bench = Bench(**LIMITED)
    for k in range(5):
        bench.sample(k)
        bench.command(k, k + 0.1, U + (k + 1) * STEP, plan=0)
    assert bench.writes[-1][1] == pytest.approx(U + 5 * STEP)
    applied = []
    for k in range(5, 14):
        bench.act_until(k * PERIOD)
        applied.append(bench.sampled(k))
    assert [state.source for state in applied[3:]] == ["safe"] * 6
    assert bench.writes[-1][1] == pytest.approx(U)
    falling = [state.applied[0] for state in applied if state.applied is not None]
    assert np.abs(np.diff(falling)).max() <= STEP * (1 + 1e-6)
    # It is reached six periods after the patience.
    assert falling[-1] == pytest.approx(U)
    assert falling[-3] == pytest.approx(U)


def test_before_the_first_command_the_actuator_is_at_the_safe_input() -> None:
    bench = Bench(**LIMITED)
    bench.sample(0)
    bench.command(0, 0.1, U + 0.7)
    assert bench.writes[-1][1] == pytest.approx(U + STEP)
    free = Bench(safe_gain=None)
    free.sample(0)
    free.command(0, 0.1, U + 0.7)
    assert free.writes[-1][1] == U + 0.7


TWO = Known.from_matrices(
    -np.eye(2),
    np.eye(2),
    W=[0.0, 0.0],
    scale={"x1": 1.0, "x2": 1.0},
    u_min=[-1.0, -1.0],
    u_max=[1.0, 1.0],
    u_rate_max=[2.0, 9.0],
    rows={"supply": {"u1": 1.0, "u2": 1.0, "min": -1.5, "max": 0.7}},
    safe_input=[0.5, 0.1],
)


@pytest.mark.parametrize("seed", range(4))
def test_rows_and_rates_hold_for_every_source(seed: int) -> None:
    """The sources are commands, their plans, the safe input and a manual input, early and late."""
    rng = np.random.default_rng(seed)
    limited = replace(TWO, u_rate_max=None) if seed == 3 else TWO
    shield = Shield(limited, PERIOD, 1.25, "plant-a", False, way_back_of(Config(rate=1.0 / PERIOD), limited))
    machine, far = _Machine(), 0
    for k in range(60):
        t = k * PERIOD
        shield.advance(t, machine)
        shield.sample(t, machine.x)
        if 20 <= k < 30:
            u = rng.uniform(-2.0, 2.0, 2).tolist()
            assert shield.override(m.Override(run_id="a", seq=k - 20, mode="manual", u=u), t) == "ok"
        shield.renew(t, machine.x, machine)
        for at in np.sort(rng.uniform(0.1, 0.9, int(rng.integers(0, 4)))) if k % 10 < 5 else ():
            shield.advance(t + at * PERIOD, machine)
            plan = rng.uniform(-2.0, 2.0, (3, 2)).tolist()
            assert shield.command(planned(k, plan, k), t + at * PERIOD) == "ok"
    times, inputs = np.array([t for t, _u in machine.writes]), np.array([u for _t, u in machine.writes])
    assert (limited.input_rows.beyond(inputs) <= 0.0).all()
    assert (np.abs(inputs) <= 1.0).all()
    for i, t in enumerate(times):
        recent = inputs[(times > t - (1 - 1e-6) * PERIOD) & (times <= t)]
        far += int((np.abs(recent - inputs[i]) > TWO.input_rates * PERIOD * (1 + 1e-5)).any())
    assert (far == 0) == (seed != 3)
    assert np.ptp(inputs, axis=0).min() > 0.3


class _Machine:
    def __init__(self) -> None:
        self.x, self.writes = np.zeros(2), list[tuple[float, np.ndarray]]()

    def read(self, due: float) -> np.ndarray:
        return self.x

    def write(self, u: np.ndarray, due: float) -> float:
        self.writes.append((due, np.array(u)))
        return due
