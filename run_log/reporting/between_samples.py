"""Largest distance of the true motion outside X between samples."""

from __future__ import annotations

import casadi as ca
import msgspec
import numpy as np

from lbmpc.plants import Description, Plant, PlantError, Truth
from lbmpc.plants.truth import dop853
from run_log.reporting.motion import Pieces, Trajectory

POINTS = 8
"""Shares of an interval with one input at which the motion is evaluated, including its end."""
SAME = 1e-6
"""Tolerance in half-widths. A motion that ends this close to the next sample is the plant's."""
AT_ONCE = 4096
"""Number of periods in memory at once."""


def excess(motion: Trajectory, plant: Description, truth: object) -> float | None:
    """Largest distance from X, as a share of the state's half-width; 0 where X is kept, samples included.

    From every sample the equations are integrated under what was applied, which takes about 0.15 ms for each.

    Args:
        motion: the samples, and what acted between them.
        plant: its bounds and rows are X.
        truth: the plant whose motion this is; it may differ from `plant`. None, or no equations: it is not known.

    Returns:
        None where that is not known: the equations do not lead from a sample to the next (a real plant, one that
        changed, measured states), there are none, they cannot be integrated, or no input was reported.
    """
    known = [k for k in range(1, len(motion.pieces)) if motion.pieces[k]]
    if not known or not isinstance(truth, Plant):
        return None
    found, steps = _beyond(motion.x, plant), _dop853(truth)
    for first in range(0, len(known), AT_ONCE):
        ends = known[first : first + AT_ONCE]
        start, end = motion.x[[k - 1 for k in ends]], motion.x[ends]
        pieces = [motion.pieces[k] for k in ends]
        passed = _fixed_steps(steps, start, pieces)
        # Steps of that length are too long for some plants.
        wrong = np.flatnonzero(~_arrived(passed, end, truth))
        if wrong.size:
            exact = Truth(truth)
            for i in wrong:
                passed[:, i] = _exact_steps(exact, start[i], pieces[i], len(passed))
                if not _arrived(passed[:, [i]], end[[i]], truth).all():
                    return None
        found = max(found, _beyond(passed, plant))
    return found if found > SAME else 0.0


def behind(motion: Trajectory, dead_time: float) -> Trajectory:
    """With what acted on a plant a dead time after it was written; where that is not known there is nothing.

    motion: of one episode; `dead_time` in seconds.
    """
    if not dead_time:
        return motion
    unknown: list[tuple[float, tuple[float, ...] | None]] = [(dead_time, None)]
    written, acted = unknown.copy(), [motion.pieces[0]]
    for pieces in motion.pieces[1:]:
        if not pieces:
            written = unknown.copy()
        written += pieces
        now: list[tuple[float, tuple[float, ...] | None]] = []
        left = sum(seconds for seconds, _u in pieces)
        hair = SAME * left
        while left > hair:
            seconds, u = written.pop(0)
            if seconds > left + hair:
                written.insert(0, (seconds - left, u))
                seconds = left
            now.append((seconds, u))
            left -= seconds
        known = tuple((seconds, u) for seconds, u in now if u is not None)
        acted.append(known if len(known) == len(now) else ())
    return msgspec.structs.replace(motion, pieces=tuple(acted))


def _beyond(x: np.ndarray, plant: Description) -> float:
    """Distance of x, (..., d), in half-widths."""
    with np.errstate(over="ignore"):
        return max(0.0, float(plant.beyond_x(x).max()))


def _arrived(passed: np.ndarray, end: np.ndarray, truth: Plant) -> np.ndarray:
    """(k,) whether the last of `passed`, (points, k, d), is the sample `end`, (k, d). NaN is not."""
    return np.asarray((np.abs(passed[-1] - end) <= SAME * (truth.x_scale + np.abs(end))).all(axis=1))


def _dop853(truth: Plant) -> ca.Function:
    x, u, dt = ca.SX.sym("x", truth.d), ca.SX.sym("u", truth.m), ca.SX.sym("dt")
    return ca.Function("dop853", [x, u, dt], [dop853(truth.function(), x, u, dt).after])


def _fixed_steps(steps: ca.Function, start: np.ndarray, pieces: list[Pieces]) -> np.ndarray:
    """(points, k, d): k periods side by side, one step from point to point."""
    together, now, passed = steps.map(len(start)), start.T, []
    for at in range(max(map(len, pieces))):
        # A period with fewer pieces stands still for the rest.
        acting = [p[at] if at < len(p) else (0.0, p[-1][1]) for p in pieces]
        u, dt = np.array([u for _seconds, u in acting]).T, np.array([[s / POINTS for s, _u in acting]])
        for _ in range(POINTS):
            now = together(now, u, dt).full()
            passed.append(now.T)
    return np.array(passed)


def _exact_steps(truth: Truth, x: np.ndarray, pieces: Pieces, points: int) -> np.ndarray:
    """(points, d) of one period; NaN where it cannot be integrated."""
    passed = np.empty((points, len(x)))
    try:
        with np.errstate(all="ignore"):
            for i in range(len(pieces) * POINTS):
                seconds, u = pieces[i // POINTS]
                passed[i:] = x = truth.step(x, np.array(u), seconds / POINTS)
    except PlantError:
        passed[:] = np.nan
    return passed
