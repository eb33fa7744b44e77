"""The true motion of a run's plant, as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import accumulate, groupby, pairwise

import msgspec
import numpy as np

from lbmpc.plants import Description
from node_runtime.config.sections import Config
from protocol.messages import PlantState
from run_log.errors import LogError
from run_log.run import Run

Pieces = tuple[tuple[float, tuple[float, ...]], ...]
"""(seconds, input (m,)) in the order in which they acted."""


class Trajectory(msgspec.Struct, frozen=True):
    """The plant's true motion from the sample that the first command answers; n samples, d states, m inputs.

    An episode is the motion of one start of the plant, likewise from the sample that its first command answers.
    """

    step: np.ndarray
    """(n,) samples since the start."""
    t: np.ndarray
    """(n,) seconds since the start, on the plant's clock."""
    x: np.ndarray
    """(n, d) plant units."""
    applied: np.ndarray
    """(n, m) mean input over the period before the sample; NaN where none was reported."""
    pieces: tuple[Pieces, ...]
    """(n,) inputs of that period; empty if not reported, or if samples are missing before this one."""
    starts: tuple[int, ...] = (0,)
    """Indices of the first samples of the episodes."""
    by_hand: tuple[tuple[float, float], ...] = ()
    """(from, to) in seconds since the start: intervals of manual control; none in a part."""
    goal: np.ndarray | None = None
    """(n, d) target of the states, plant units, if a reference other than the configured one was given; else None."""

    def part(self, first: int, last: int) -> Trajectory:
        """Return the motion of the samples `first` to `last`, the last one included, as a trajectory of its own."""
        within = slice(first, last + 1)
        applied = self.applied[within].copy()
        # The input before the first sample does not belong to this part.
        applied[:1] = np.nan
        step, t = self.step[within], self.t[within]
        pieces = ((), *self.pieces[within][1:])
        goal = None if self.goal is None else self.goal[within]
        return Trajectory(step - step[:1], t - t[:1], self.x[within], applied, pieces, goal=goal)

    def episodes(self) -> list[Trajectory]:
        """Return each episode as a trajectory of its own."""
        return [self.part(first, behind - 1) for first, behind in pairwise((*self.starts, len(self.step)))]


def trajectory(run: Run, plant: Description) -> Trajectory:
    """The true motion, without the hold before it, and without the hold at each later start of the plant.

    States of strangers (plants that no tick of the log answers) are left out.

    Raises:
        LogError: the log holds no state of this plant's size.
    """
    controllers = set(run.controllers)
    followed = {t.state.run_id for t in run.ticks if t.state is not None and t.run_id in controllers}
    states = [s for s in run.plant_states if len(s.x) == plant.d and (s.run_id in followed or not followed)]
    if not states:
        raise LogError(
            f"{run.path}: contains no state of a plant with {plant.d} states ({', '.join(plant.states)})"
        )
    by_plant: dict[str, list[PlantState]] = {}
    for s in states:
        by_plant.setdefault(s.run_id, []).append(s)
    moved = [found for one in by_plant.values() if (found := _after_the_hold(one))]
    # For a plant that never moved, its last sample is everything.
    starts = moved or [states[-1:]]
    whole = motion(starts, plant, run.config.period)
    return msgspec.structs.replace(whole, goal=_asked(run, [s for one in starts for s in one], plant))


def goal(plant: Description, config: Config) -> np.ndarray:
    """Where the states should be by the configuration, (d,), plant units: x_e, but for the outputs that the reference
    gives a value."""
    reference = config.reference
    values = reference.values if reference.outputs else None
    return with_outputs(
        plant, {} if values is None else dict(zip(reference.outputs or [], values, strict=True))
    )


def with_outputs(plant: Description, values: Mapping[str, float]) -> np.ndarray:
    """x_e, (d,), plant units, with the given values of states."""
    wanted = plant.x_e.copy()
    wanted[[plant.states.index(name) for name in values]] = [*values.values()]
    return wanted


def _asked(run: Run, states: list[PlantState], plant: Description) -> np.ndarray | None:
    """(n, d) of `Trajectory.goal`. A sample without a tick has the goal of the previous sample."""
    given = {(r.run_id, r.seq): r.reference for r in run.results if r.reference}
    configured = goal(plant, run.config)
    goals = {key: with_outputs(plant, values) for key, values in given.items()}
    if all((one == configured).all() for one in goals.values()):
        return None
    of_sample = {
        (tick.state.run_id, tick.state.seq): goals.get((tick.run_id, tick.seq), configured)
        for tick in run.ticks
        if tick.state is not None
    }
    found = [configured]
    for s in states:
        found.append(of_sample.get((s.run_id, s.seq), found[-1]))
    return np.array(found[1:])


def motion(episodes: list[list[PlantState]], plant: Description, period: float) -> Trajectory:
    """The trajectory of these samples, each with the plant's number of states; none of the lists is empty."""
    states = [s for one in episodes for s in one]
    nothing = [np.nan] * plant.m
    applied = [nothing if s.applied is None or len(s.applied) != plant.m else s.applied for s in states]
    # A restarted plant counts its samples from zero again; on another machine its seconds too.
    step: list[int] = []
    t: list[float] = []
    offset, t_offset = -states[0].seq, -states[0].t
    for before, s in zip([states[0], *states], states, strict=False):
        if s.run_id != before.run_id:
            offset = step[-1] + 1 - s.seq
            t_offset = t_offset if s.t >= before.t else t[-1] + period - s.t
        step.append(s.seq + offset)
        t.append(s.t + t_offset)
    known = [
        _pieces(s, plant.m, period) if (s.run_id, s.seq) == (before.run_id, before.seq + 1) else ()
        for before, s in pairwise(states)
    ]
    starts = (0, *accumulate(len(one) for one in episodes[:-1]))
    x = np.array([s.x for s in states])
    spans = _by_hand(states, t, period)
    return Trajectory(np.array(step), np.array(t), x, np.array(applied), ((), *known), starts, spans)


def _by_hand(states: list[PlantState], t: list[float], period: float) -> tuple[tuple[float, float], ...]:
    """A sample reports the input before it."""
    groups = groupby(zip(t, states, strict=True), key=lambda one: one[1].source == "manual")
    driven = [[at for at, _state in group] for by_hand, group in groups if by_hand]
    return tuple((times[0] - period, times[-1]) for times in driven)


def _after_the_hold(states: list[PlantState]) -> list[PlantState]:
    """The samples from the one that the first command answers; empty if no command came."""
    # A machine that cannot be held waits under its safe input.
    moving = next((i for i, s in enumerate(states) if s.source != "hold" and s.command_seq >= 0), None)
    return [] if moving is None else states[max(moving - 1, 0) :]


def _pieces(state: PlantState, m: int, period: float) -> Pieces:
    if state.pieces:
        found = tuple((piece.seconds, tuple(piece.u)) for piece in state.pieces)
    else:
        found = () if state.applied is None else ((period, tuple(state.applied)),)
    return found if all(len(u) == m for _seconds, u in found) else ()
