"""The data of the pictures, as arrays on one time axis: seconds since the plant began to move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lbmpc.plants import Description
from protocol import topics
from run_log.errors import LogError
from run_log.reporting.motion import Trajectory, trajectory
from run_log.run import Run, plant_of


@dataclass(frozen=True)
class Traces:
    """One run, ready to draw. n ticks, d states, m inputs; NaN where a tick has no such figure."""

    plant: Description
    period: float
    motion: Trajectory
    t: np.ndarray
    """(n,) time of each tick."""
    u: np.ndarray
    """(n, m) commanded input."""
    h: np.ndarray
    """(n, d) measured model error of the step that ended at the tick."""
    h_hat: np.ndarray
    """(n, d) its estimate."""
    error: np.ndarray
    """(n,) |h_hat - h|."""
    reference: np.ndarray
    """(n, d) reference of each state, NaN for states that are no outputs, plant units."""
    target_x: np.ndarray
    target_u: np.ndarray
    """(n, d) and (n, m) the target of the plan; NaN if that is the equilibrium."""
    weight: np.ndarray
    constant_weight: np.ndarray
    """(n, d) weights of the network, and of a constant beside it."""
    fallback: np.ndarray
    """(n,) whether the input did not come from the solver."""
    version: np.ndarray
    """(n,) version of the hidden weights in use, -1 before the first."""
    adopted: np.ndarray
    refused: np.ndarray
    rolled_back: np.ndarray
    """(n,) booleans."""
    late: np.ndarray
    solve_ms: np.ndarray
    tick_ms: np.ndarray
    losses: np.ndarray
    """(k, 3) time at which hidden weights arrived, loss before and after their training."""


def traces(run: Run) -> Traces:
    """Raises `LogError` if the plant is unknown here, or the log contains none of its states or no tick."""
    plant = plant_of(run)
    motion = trajectory(run, plant)
    controllers = set(run.controllers)
    results = [r for r in run.results if r.run_id in controllers]
    if not results:
        raise LogError(f"{run.path}: contains no tick of a controller; there is nothing to draw")
    keys = [(r.run_id, r.seq) for r in results]
    when = _tick_times(run, motion)
    ticks = {(tick.run_id, tick.seq): tick for tick in run.ticks}
    timings = {(timing.run_id, timing.seq): timing for timing in run.timings}

    def vectors(rows: list[list[float] | None], length: int) -> np.ndarray:
        absent = [np.nan] * length
        return np.array([absent if row is None or len(row) != length else row for row in rows])

    # For a tick that is not in the log (a cut), the grid of slots gives the time.
    t0 = next(iter(when.values()), 0.0)
    return Traces(
        plant=plant,
        period=run.config.period,
        motion=motion,
        t=np.array([when.get(key, t0 + key[1] * run.config.period) for key in keys]),
        u=vectors([r.u for r in results], plant.m),
        h=vectors([r.h for r in results], plant.d),
        h_hat=vectors([r.h_hat for r in results], plant.d),
        error=np.array([np.nan if r.prediction_error is None else r.prediction_error for r in results]),
        reference=np.array([[r.reference.get(name, np.nan) for name in plant.states] for r in results]),
        target_x=vectors([r.target_x for r in results], plant.d),
        target_u=vectors([r.target_u for r in results], plant.m),
        weight=vectors([r.weight for r in results], plant.d),
        constant_weight=vectors([r.constant_weight for r in results], plant.d),
        fallback=np.array([r.mode != "solver" for r in results]),
        version=np.array([r.hidden_version for r in results]),
        adopted=np.array([r.weights_outcome == "adopted" for r in results]),
        refused=np.array([r.weights_outcome == "refused" for r in results]),
        rolled_back=np.array([bool(r.weights_rolled_back) for r in results]),
        late=np.array([key in ticks and ticks[key].late for key in keys]),
        solve_ms=np.array([timings[key].solve_ms if key in timings else np.nan for key in keys]),
        tick_ms=np.array([timings[key].tick_ms if key in timings else np.nan for key in keys]),
        losses=_losses(run, motion),
    )


def _tick_times(run: Run, motion: Trajectory) -> dict[tuple[str, int], float]:
    """Return the time of each tick on the plant's clock. The answered states relate the controller's clock to it."""
    states = [s for s in run.plant_states if s.command_seq >= 0] or run.plant_states
    sampled = {(s.run_id, s.seq): s.t for s in run.plant_states}
    start = states[0].t - (motion.t[1] if len(motion.t) > 1 and states[0].command_seq >= 0 else 0.0)
    offsets: dict[str, list[float]] = {}
    for tick in run.ticks:
        if tick.state is not None and tick.state_verdict == "fresh":
            at = sampled.get((tick.state.run_id, tick.state.seq), tick.state.t)
            offsets.setdefault(tick.run_id, []).append(at - start - tick.t)
    shift = {run_id: float(np.median(values)) for run_id, values in offsets.items()}
    return {(tick.run_id, tick.seq): tick.t + shift.get(tick.run_id, 0.0) for tick in run.ticks}


def _losses(run: Run, motion: Trajectory) -> np.ndarray:
    states = run.entries(topics.PLANT_STATE)
    moving = [entry.log_time for entry in states if entry.message.command_seq >= 0]
    zero = moving[0] - (motion.t[1] if len(motion.t) > 1 else 0.0) * 1e9 if moving else 0.0
    rows = [
        ((entry.log_time - zero) * 1e-9, entry.message.loss_before, entry.message.loss_after)
        for entry in run.entries(topics.HIDDEN_WEIGHTS)
    ]
    return np.array(rows).reshape(-1, 3)
