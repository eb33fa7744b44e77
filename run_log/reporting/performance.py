"""The yardstick: quality of a true motion, in the objective and beside it."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

import msgspec
import numpy as np

from lbmpc.plants import Description
from node_runtime.config.plant import true_dead_time
from node_runtime.config.sections import Config
from run_log.reporting.between_samples import behind, excess
from run_log.reporting.motion import Trajectory, goal

TOLERANCE = 1e-6
"""Half-widths: a larger distance outside X or U is a violation."""
SETTLED = 0.04
"""Half-widths: a performance state this close to its equilibrium is settled."""
FARTHEST = 1e100
"""Position of a lost plant: its square is still a number."""


class Performance(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of a true motion, or of a part of it. Performance states are named by the plant's own names; they are the
    outputs of the reference where it has any, and "equilibrium" is then where they should be.

    Of several episodes: the mean of J and of the deviation, the sum of the violations, of all else the worst.
    """

    J: float
    """Sum of the stage costs, dx' Q dx + du' R du times the period, with the densities Q and R of the configuration
    and the mean input that was applied; an input that the log does not know counts nothing. dx is from `goal`, or
    from where the reference of the sample was, if another was given; du is from u_e. So it is the same for every
    oracle, wherever what it has learned lets it aim."""
    deviation: float
    """Integral of the summed squared deviations of the performance states, plant units squared times seconds."""
    overshoot: dict[str, float | None]
    """Per performance state: how far beyond its equilibrium it got, as a share of its initial deviation; null where
    it began settled, or where the reference moves."""
    settled_s: float | None
    """Seconds after which all performance states stay within 4 % of their half-width of the equilibrium; null where
    one of them is not settled at the end."""
    settled_by_state_s: dict[str, float | None]
    """The same for each performance state."""
    constraint_violations: int
    """Samples at which the true state, or the mean input before it, is outside X or U by more than 1e-6 of a
    half-width."""
    violated_rows: dict[str, int] = {}
    """Of these, per row beside the boxes of X and U, by its name; empty where there are none."""
    excess_between_samples: float | None
    """Largest distance of the true motion from X, between samples too, as a share of the state's half-width; null
    where the equations of the truth do not lead from sample to sample."""
    offset: dict[str, float] = {}
    """Per output of the reference: its mean distance from where it should be in the last second, at least in the last
    sample, as a share of its half-width; empty without outputs, neither configured nor given."""


def performance(
    motion: Trajectory,
    plant: Description,
    config: Config,
    truth: object,
    u_goal: np.ndarray | None = None,
) -> Performance:
    """Figures of `motion`, which may be a part of a run (`Trajectory.part`).

    Args:
        motion: the samples.
        plant: its equilibrium, bounds and half-widths.
        config: the weights and the rate.
        truth: the plant whose motion this is, as of `excess`.
        u_goal: where the input should be in each period, (n - 1, m), plant units; None: at u_e.
    """
    names = config.reference.outputs or [plant.states[i] for i in plant.performance]
    own = [plant.states.index(name) for name in names]
    given = goal(plant, config) if motion.goal is None else motion.goal
    moves = motion.goal is not None and bool((motion.goal != motion.goal[0]).any())
    aim = plant.u_e if u_goal is None else u_goal
    dx, du = (
        np.clip(off, -FARTHEST, FARTHEST)
        for off in (motion.x - given, np.nan_to_num(motion.applied[1:] - aim))
    )
    q, r = (
        np.ones(n) if w is None else np.array(w)
        for n, w in ((plant.d, config.controller.Q), (plant.m, config.controller.R))
    )
    # Periods from a sample to the next one; more than one where samples are missing.
    seconds = np.diff(motion.step) / config.rate
    squares = dx[:-1] ** 2
    stages = squares @ q + du**2 @ r
    off = np.abs(dx) > SETTLED * plant.x_scale
    settled = {
        name: _settled(off[:, i], motion.step, config.rate) for name, i in zip(names, own, strict=True)
    }
    times = [time for time in settled.values() if time is not None]
    return Performance(
        J=float(seconds @ stages),
        deviation=float(seconds @ squares[:, own].sum(axis=1)),
        overshoot={
            name: _overshoot(dx[:, i], bool(off[0, i]) and not moves)
            for name, i in zip(names, own, strict=True)
        },
        settled_s=max(times) if len(times) == len(settled) else None,
        settled_by_state_s=settled,
        constraint_violations=int(outside(motion, plant).sum()),
        violated_rows={name: int(found.sum()) for name, found in outside_rows(motion, plant).items()},
        excess_between_samples=excess(behind(motion, true_dead_time(config, plant, truth)), plant, truth),
        offset=_offset(motion, dx, plant, config),
    )


def of_episodes(every: Sequence[Performance]) -> Performance:
    """Return the figures of several episodes together; a single one keeps its own."""
    names = list(every[0].overshoot)
    overshoots = {name: [v for one in every if (v := one.overshoot[name]) is not None] for name in names}
    return Performance(
        J=fmean(one.J for one in every),
        deviation=fmean(one.deviation for one in every),
        overshoot={name: max(values, default=None) for name, values in overshoots.items()},
        settled_s=_largest([one.settled_s for one in every]),
        settled_by_state_s={
            name: _largest([one.settled_by_state_s[name] for one in every]) for name in names
        },
        constraint_violations=sum(one.constraint_violations for one in every),
        violated_rows={
            name: sum(one.violated_rows[name] for one in every) for name in every[0].violated_rows
        },
        excess_between_samples=_largest([one.excess_between_samples for one in every]),
        offset={
            name: max(one.offset[name] for one in every if name in one.offset)
            for name in dict.fromkeys(name for one in every for name in one.offset)
        },
    )


def outside(motion: Trajectory, plant: Description) -> np.ndarray:
    """(n,) whether the true state or the applied input is outside X or U by more than 1e-6 of a half-width."""
    x, u = motion.x, motion.applied
    x_room, u_room = TOLERANCE * plant.x_scale, TOLERANCE * plant.u_scale
    state = (x < plant.x_min - x_room) | (x > plant.x_max + x_room)
    applied = (u < plant.u_min - u_room) | (u > plant.u_max + u_room)  # false without an input
    rows = outside_rows(motion, plant).values()
    return np.asarray(state.any(axis=1) | applied.any(axis=1) | np.any([*rows], axis=0))


def outside_rows(motion: Trajectory, plant: Description) -> dict[str, np.ndarray]:
    """(n,) by the name of a row beside the boxes: whether it is exceeded, likewise."""
    return {
        name: beyond > TOLERANCE
        for rows, values in ((plant.state_rows, motion.x), (plant.input_rows, motion.applied))
        for name, beyond in zip(rows.names, rows.beyond(values).T, strict=True)
    }


def _largest(values: list[float | None]) -> float | None:
    """None if one of them is None."""
    known = [value for value in values if value is not None]
    return max(known) if len(known) == len(values) else None


def _offset(motion: Trajectory, dx: np.ndarray, plant: Description, config: Config) -> dict[str, float]:
    late = dx[motion.step > motion.step[-1] - max(1.0, config.rate)]
    columns = [plant.states.index(name) for name in config.reference.outputs or []]
    if motion.goal is not None:
        asked = np.flatnonzero((motion.goal != goal(plant, config)).any(axis=0))
        columns += [i for i in asked.tolist() if i not in columns]
    return {plant.states[i]: float(np.abs(late[:, i]).mean() / plant.x_scale[i]) for i in columns}


def _overshoot(dx: np.ndarray, began_off: bool) -> float | None:
    if not began_off:
        return None
    return max(0.0, float((-dx / dx[0]).max()))


def _settled(off: np.ndarray, step: np.ndarray, rate: float) -> float | None:
    """Seconds until the first sample from which on none is off."""
    if off[-1]:
        return None
    last = np.flatnonzero(off)
    return float(step[last[-1] + 1] / rate) if last.size else 0.0
