"""Figures of a run, as `tandem run`, `simulate` and `report` print them."""

from __future__ import annotations

import msgspec
import numpy as np

from lbmpc.solver.solution import Status
from protocol import messages as m
from run_log.reading.gaps import lost_ticks
from run_log.reporting.motion import trajectory
from run_log.reporting.performance import Performance, of_episodes, performance
from run_log.run import Run, plant_of, true_plant_of

SOFT = 1e-9
ADDS = 0.1
"""Largest weight of h_hat in any state below which learning adds nothing."""
ADDS_NOTHING = "learning adds nothing: noise exceeds h"


class Spread(msgspec.Struct, frozen=True):
    """Percentiles of a duration, milliseconds."""

    p50: float
    p99: float
    max: float


class PredictionError(msgspec.Struct, frozen=True):
    """Mean of |h_hat - h| over the first and the last second, or period if longer; null where no tick in it has one."""

    first_second: float | None
    last_second: float | None


class Summary(Performance, frozen=True, kw_only=True):
    """Figures of the true plant (from its own states after the hold) and of the control loop.

    Each start of the plant is an episode. The figures of the true plant cover all episodes, as in `Performance`.
    """

    episodes: list[Performance]
    """Cost of each episode."""
    ticks: int
    late_ticks: int
    """Ticks that began late, or ended after their period."""
    skipped_slots: int
    lost_ticks: int
    """Incomplete ticks of the log, which the recorder did not receive completely; no figure includes them."""
    weights_adopted: int
    weights_refused: int
    weights_rolled_back: int
    """Sets that were adopted and then rolled back."""
    iteration_limit_ticks: int
    """Ticks whose solve was stopped by `controller.solver.max_iterations`."""
    soft_ticks: int
    """Ticks that needed slack in a soft state constraint, above 1e-9."""
    fallback_ticks: int
    """Ticks whose input did not come from the solver."""
    unreached_ticks: int | None
    """Ticks whose target's outputs differ from the reference, or without an equilibrium; null without a reference."""
    sensor_faults: list[str]
    """Sensor faults with their times, in words."""
    target_distance: float | None
    """Distance of the last target's outputs from the reference, the largest share of an output's half-width."""
    solve_ms: Spread | None
    tick_ms: Spread | None
    prediction_error: PredictionError
    weight: dict[str, float] | None
    """Weight of the network in the prediction of each state, 0 to 1: the mean of the last second, or period if longer;
    null without weights."""
    constant_weight: dict[str, float] | None
    """Weight of the constant beside it, likewise."""
    noise: dict[str, float] | None
    """Standard deviation of the measurement of each state as estimated at the end, plant units; null if it is
    configured or there is no estimator."""
    outside_ticks: int | None
    """Ticks in a state outside the certified sets, where nothing is guaranteed; null without sets."""
    smallest_set_margin: float | None
    """Smallest distance of a tick's state to their boundary, as a share of X's half-widths, negative outside."""
    log: str | None


def summarise(run: Run) -> Summary:
    """Raises `LogError` if the plant is unknown here, or the log contains none of its states."""
    plant, truth = plant_of(run), true_plant_of(run)
    controllers = set(run.controllers)
    ticks = [tick for tick in run.ticks if tick.run_id in controllers]
    results = [r for r in run.results if r.run_id in controllers]
    margins = [r.set_margin for r in results if r.set_margin is not None]
    aimed = [r for r in results if r.target_status != "none"]
    timings = [timing for timing in run.timings if timing.run_id in controllers]
    episodes = [performance(one, plant, run.config, truth) for one in trajectory(run, plant).episodes()]
    return Summary(
        **msgspec.structs.asdict(of_episodes(episodes)),
        episodes=episodes,
        ticks=len(ticks),
        late_ticks=_late(run.config.period, ticks, timings),
        skipped_slots=sum(tick.skipped for tick in ticks),
        lost_ticks=sum(count for _run_id, _first, count in lost_ticks(run)),
        weights_adopted=sum(r.weights_outcome == "adopted" for r in results),
        weights_refused=sum(r.weights_outcome == "refused" for r in results),
        weights_rolled_back=sum(bool(r.weights_rolled_back) for r in results),
        iteration_limit_ticks=sum(r.status == Status.ITERATION_LIMIT for r in results),
        soft_ticks=sum(r.slack > SOFT for r in results),
        fallback_ticks=sum(r.mode != "solver" for r in results),
        unreached_ticks=sum(r.target_status != "reached" for r in aimed) if aimed else None,
        sensor_faults=_sensor_faults(run.config.period, ticks, results),
        target_distance=aimed[-1].target_distance if aimed else None,
        solve_ms=_spread([timing.solve_ms for timing in timings]),
        tick_ms=_spread([timing.tick_ms for timing in timings]),
        prediction_error=_prediction_error(run.config.period, ticks, results),
        weight=_weight(run, plant.states, [r.weight for r in results]),
        constant_weight=_weight(run, plant.states, [r.constant_weight for r in results]),
        noise=results[-1].noise_of(plant.states) if results else None,
        outside_ticks=sum(margin < 0.0 for margin in margins) if margins else None,
        smallest_set_margin=min(margins, default=None),
        log=str(run.path) if run.path.name else None,
    )


def _sensor_faults(period: float, ticks: list[m.Tick], results: list[m.TickResult]) -> list[str]:
    when = {(tick.run_id, tick.seq): tick.t for tick in ticks}
    told: list[str] = []
    now: dict[str, str] = {}
    for result in results:
        t = when.get((result.run_id, result.seq), result.seq * period)
        for name in now.keys() - result.sensor_faults.keys():
            told.append(f"{now.pop(name)}; trusted again from {t:.1f} s")
        for name, fault in result.sensor_faults.items():
            now.setdefault(name, m.words_of_fault(name, fault, t))
    return [*told, *now.values()]


def _weight(run: Run, states: tuple[str, ...], found: list[list[float]]) -> dict[str, float] | None:
    last = [one for one in found[-max(1, round(run.config.rate)) :] if len(one) == len(states)]
    return dict(zip(states, np.mean(last, axis=0).tolist(), strict=True)) if last else None


def _spread(values: list[float]) -> Spread | None:
    if not values:
        return None
    return Spread(float(np.percentile(values, 50)), float(np.percentile(values, 99)), max(values))


def _late(period: float, ticks: list[m.Tick], timings: list[m.TickTiming]) -> int:
    overrun = {(t.run_id, t.seq) for t in timings if t.lateness_ms + t.tick_ms > period * 1e3}
    return sum(tick.late or (tick.run_id, tick.seq) in overrun for tick in ticks)


def _prediction_error(period: float, ticks: list[m.Tick], results: list[m.TickResult]) -> PredictionError:
    when = {(tick.run_id, tick.seq): tick.t for tick in ticks}
    known = [(r, error) for r in results if (error := r.prediction_error) is not None]
    if not known:
        return PredictionError(None, None)

    window = max(1.0, period)

    def mean(of: str, *, first: bool) -> float | None:
        run = [(r, error) for r, error in known if r.run_id == of]
        t = np.array([when.get((r.run_id, r.seq), r.seq * period) for r, _error in run])
        # Half a period of tolerance, because the grid of slots is only approximate in floating point.
        near = t < t[0] + window - period / 2 if first else t > t[-1] - window + period / 2
        errors = [error for (_r, error), inside in zip(run, near, strict=True) if inside]
        # A second may hold no tick.
        return float(np.mean(errors)) if errors else None

    return PredictionError(mean(known[0][0].run_id, first=True), mean(known[-1][0].run_id, first=False))
