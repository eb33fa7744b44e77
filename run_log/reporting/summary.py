"""A run in figures: what `tandem run`, `simulate` and `report` print."""

from __future__ import annotations

import msgspec
import numpy as np

from lbmpc.plants import Plant
from protocol import messages as m
from run_log.errors import LogError
from run_log.reading.gaps import lost_ticks
from run_log.run import Run, plant_of

TOLERANCE = 1e-6
SETTLED = 0.02
SOFT = 1e-9


class Spread(msgspec.Struct, frozen=True):
    """Percentiles of a duration, milliseconds."""

    p50: float
    p99: float
    max: float


class PredictionError(msgspec.Struct, frozen=True):
    """Mean of |h_hat - h| over the first and the last second; null where no tick has one."""

    first_second: float | None
    last_second: float | None


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of the true plant (from its own states after the hold) and of the control loop."""

    ticks: int
    late_ticks: int
    """Ticks that began late, or ended after their period."""
    skipped_slots: int
    lost_ticks: int
    """Ticks of which the log lacks something: it never reached the recorder, and all figures lack it too."""
    weights_adopted: int
    weights_refused: int
    weights_rolled_back: int
    """Sets that were adopted and did not hold what their trial promised."""
    fallback_ticks: int
    """Ticks whose input did not come from the solver."""
    soft_ticks: int
    """Ticks that needed slack in a soft state constraint, above 1e-9."""
    constraint_violations: int
    """Samples at which the true state or the applied input is outside X or U by more than 1e-6."""
    cost: float
    """Sum over the samples of the squared deviation of the plant's performance states."""
    overshoot: float
    """Largest deviation x - x_e of the first performance state."""
    settling_step: int
    """Last sample with a performance state further than 0.02 from its equilibrium; 0 when there is none."""
    final_deviation: float
    """Largest |x - x_e| among the performance states in the last sample."""
    solve_ms: Spread | None
    tick_ms: Spread | None
    prediction_error: PredictionError
    outside_ticks: int | None
    """Ticks in a state outside the certified sets, where nothing is guaranteed; null where none are in force."""
    smallest_set_margin: float | None
    """Smallest distance of a tick's state to their boundary, as a share of X's half-widths, negative outside."""
    log: str | None


class Trajectory(msgspec.Struct, frozen=True):
    """The plant's true motion from the sample that the first command answers."""

    step: np.ndarray
    """(n,) samples since the start."""
    t: np.ndarray
    """(n,) seconds since the start, on the plant's clock."""
    x: np.ndarray
    """(n, d) plant units."""
    applied: np.ndarray
    """(n, m) mean input over the period before the sample; NaN where none was reported."""


def trajectory(run: Run, plant: Plant) -> Trajectory:
    """The true motion, without the hold before it.

    States of strangers (plants that no tick of the log answers) are left out.

    Raises:
        LogError: the log holds no state of this plant's size.
    """
    controllers = set(run.controllers)
    followed = {t.state.run_id for t in run.ticks if t.state is not None and t.run_id in controllers}
    states = [s for s in run.plant_states if len(s.x) == plant.d and (s.run_id in followed or not followed)]
    if not states:
        raise LogError(
            f"{run.path}: holds no state of a plant with {plant.d} states ({', '.join(plant.states)})"
        )
    moving = [i for i, s in enumerate(states) if s.source != "hold"]
    first = max(moving[0] - 1, 0) if moving else len(states) - 1
    states = states[first:]
    nothing = [np.nan] * plant.m
    applied = [nothing if s.applied is None or len(s.applied) != plant.m else s.applied for s in states]
    # A plant that was started again counts its samples and its seconds from zero again.
    step: list[int] = []
    t: list[float] = []
    offset, t_offset = -states[0].seq, -states[0].t
    for before, s in zip([states[0], *states], states, strict=False):
        if s.run_id != before.run_id:
            offset, t_offset = step[-1] + 1 - s.seq, t[-1] + run.config.period - s.t
        step.append(s.seq + offset)
        t.append(s.t + t_offset)
    return Trajectory(np.array(step), np.array(t), np.array([s.x for s in states]), np.array(applied))


def summarise(run: Run) -> Summary:
    """Raises `LogError`: the plant is unknown here, or the log holds none of its states."""
    plant = plant_of(run)
    motion = trajectory(run, plant)
    controllers = set(run.controllers)
    ticks = [tick for tick in run.ticks if tick.run_id in controllers]
    results = [r for r in run.results if r.run_id in controllers]
    margins = [r.set_margin for r in results if r.set_margin is not None]
    timings = [timing for timing in run.timings if timing.run_id in controllers]
    performance = list(plant.performance)
    deviation = motion.x[:, performance] - plant.x_e[performance]
    unsettled = motion.step[(np.abs(deviation) > SETTLED).any(axis=1)]
    return Summary(
        ticks=len(ticks),
        late_ticks=_late(run.config.period, ticks, timings),
        skipped_slots=sum(tick.skipped for tick in ticks),
        lost_ticks=sum(count for _run_id, _first, count in lost_ticks(run)),
        weights_adopted=sum(r.weights_outcome == "adopted" for r in results),
        weights_refused=sum(r.weights_outcome == "refused" for r in results),
        weights_rolled_back=sum(bool(r.weights_rolled_back) for r in results),
        fallback_ticks=sum(r.mode != "solver" for r in results),
        soft_ticks=sum(r.slack > SOFT for r in results),
        constraint_violations=int(outside(motion, plant).sum()),
        cost=float(np.sum(deviation**2)),
        overshoot=float(deviation[:, 0].max()),
        settling_step=int(unsettled[-1]) if unsettled.size else 0,
        final_deviation=float(np.abs(deviation[-1]).max()),
        solve_ms=_spread([timing.solve_ms for timing in timings]),
        tick_ms=_spread([timing.tick_ms for timing in timings]),
        prediction_error=_prediction_error(run.config.period, ticks, results),
        outside_ticks=sum(margin < 0.0 for margin in margins) if margins else None,
        smallest_set_margin=min(margins, default=None),
        log=str(run.path) if run.path.name else None,
    )


def outside(motion: Trajectory, plant: Plant) -> np.ndarray:
    """(n,) whether the true state or the applied input is outside X or U by more than 1e-6."""
    x, u = motion.x, motion.applied
    state = (x < plant.x_min - TOLERANCE) | (x > plant.x_max + TOLERANCE)
    applied = (u < plant.u_min - TOLERANCE) | (u > plant.u_max + TOLERANCE)  # false where there was none
    return np.asarray(state.any(axis=1) | applied.any(axis=1))


def _spread(values: list[float]) -> Spread | None:
    if not values:
        return None
    return Spread(float(np.percentile(values, 50)), float(np.percentile(values, 99)), max(values))


def _late(period: float, ticks: list[m.Tick], timings: list[m.TickTiming]) -> int:
    overrun = {(t.run_id, t.seq) for t in timings if t.lateness_ms + t.tick_ms > period * 1e3}
    return sum(tick.late or (tick.run_id, tick.seq) in overrun for tick in ticks)


def _prediction_error(period: float, ticks: list[m.Tick], results: list[m.TickResult]) -> PredictionError:
    when = {(tick.run_id, tick.seq): tick.t for tick in ticks}
    known = [r for r in results if r.prediction_error is not None]
    if not known:
        return PredictionError(None, None)

    def mean(of: str, *, first: bool) -> float:
        run = [r for r in known if r.run_id == of]
        t = np.array([when.get((r.run_id, r.seq), r.seq * period) for r in run])
        # Half a period of slack, since the slots are on a grid that floats only approximate.
        near = t < t[0] + 1.0 - period / 2 if first else t > t[-1] - 1.0 + period / 2
        return float(np.mean([r.prediction_error for r, inside in zip(run, near, strict=True) if inside]))

    return PredictionError(mean(known[0].run_id, first=True), mean(known[-1].run_id, first=False))
