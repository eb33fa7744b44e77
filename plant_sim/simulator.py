"""A true motion as a machine to read and to write, and such a machine behind the rules in virtual time."""

from __future__ import annotations

import copy
import math

import numpy as np

from lbmpc.plants import Description, PlantError, TrueMotion
from plant_sim.hand import Hand, HandVerdict
from plant_sim.shield import Shield, Verdict
from plant_sim.way_back import WayBack
from protocol.messages import Backup, Command, Override, PlantState


class Motion:
    """A `Machine` that moves as its truth says under what is written, at the times for which the calls are due.

    It stands still at x0 until the first `write`. What is written then acts, or what was there before until the dead
    time is over. Times must not fall.
    """

    def __init__(
        self,
        truth: TrueMotion,
        x0: np.ndarray,
        period: float,
        dead_time: float = 0.0,
        before: np.ndarray | None = None,
    ):
        """x0: (d,), plant units. before: (m,), what acts until the first input does; needed with a dead time."""
        self.truth = truth
        self._dead_time, self._before = dead_time, before
        self._coming: list[tuple[float, np.ndarray]] = []
        self._x = np.array(x0, dtype=float)
        self._period = period
        self._t = -math.inf
        self._u: np.ndarray | None = None
        self._first: float | None = None
        self._ahead: tuple[float, np.ndarray] | None = None

    def change(self, truth: TrueMotion) -> None:
        """From the last call on the motion is another: an experiment with a plant that drifts."""
        self.truth, self._ahead = truth, None

    def read(self, due: float) -> np.ndarray:
        """x at that time, (d,). Raises `PlantError`: the motion cannot be followed to there."""
        self._first = due if self._first is None else self._first
        self._go(due)
        return self._x

    def write(self, u: np.ndarray, due: float) -> float:
        """From that time on u, (m,), acts. Raises as `read` does."""
        self._go(due)
        if self._u is None and self._dead_time:
            self._u = self._before
        self._coming.append((due + self._dead_time, u))
        self._let_act(due)
        return due

    def look_ahead(self) -> None:
        """Work out the next sample now: reading it is then quick, unless another input is written. Raises as `read`."""
        if self._first is None or self._u is None:
            return
        # A hair of rounding must not make it the sample that was.
        samples = math.floor((self._t - self._first) / self._period + 1e-6) + 1
        t = self._first + samples * self._period
        if self._coming and self._coming[0][0] < t:
            # Another input takes over before.
            return
        self._ahead = t, self._after(t)

    def _go(self, t: float) -> None:
        while self._let_act(t):
            pass
        self._move(t)

    def _let_act(self, t: float) -> bool:
        """The next input takes over if it has to by time t; whether one did."""
        # A switch that rounding puts a hair beside a sample is at the sample.
        hair = 1e-9 * self._period
        if not self._coming or self._coming[0][0] > t + hair:
            return False
        at, u = self._coming.pop(0)
        self._move(t if at > t - hair else at)
        self._u, self._ahead = u, None
        return True

    def _move(self, t: float) -> None:
        if t > self._t:
            if self._u is not None:
                self._x = self._after(t)
            self._t = t

    def _after(self, t: float) -> np.ndarray:
        """x(t), (d,), under the present input."""
        assert self._u is not None
        if self._ahead is not None and math.isclose(
            self._ahead[0], t, rel_tol=1e-15, abs_tol=1e-9 * self._period
        ):
            return self._ahead[1]
        # Differences of large times are not exact; the period is.
        dt = self._period if math.isclose(t - self._t, self._period, rel_tol=1e-6) else t - self._t
        x = np.asarray(self.truth.step(self._x, self._u, dt), dtype=float)
        if x.shape != self._x.shape or not np.isfinite(x).all():
            raise PlantError(
                f"the true motion leads from {self._x.tolist()} to {x.tolist()}, which is no state"
            )
        return x


class PlantSim:
    """A simulated plant in virtual time, between its commands and its samples. No clock: every time is an argument.

    It is held at x0 until the first command that answers one of its own samples, and moves from then on. Commands act
    from their arrival; `sample` goes on up to its own time, so a command may be handed in late as long as its arrival
    time is right. The same calls give the same numbers.
    """

    def __init__(
        self,
        plant: Description,
        truth: TrueMotion,
        period: float,
        x0: np.ndarray,
        plan_patience: float,
        run_id: str,
        dead_time: float = 0.0,
        way_back: WayBack | None = None,
    ):
        """x0: (d,), plant units. plan_patience: periods without a command before the plan goes on.

        dead_time: seconds, of the truth, from a command's arrival until it acts. Until the first does, the safe input
            acts, without its gain.
        way_back: whether an input by hand may act; None: none does.
        """
        self._way_back = way_back
        self._shield = Shield(plant, period, plan_patience, run_id, True, way_back)
        self._motion = Motion(truth, x0, period, dead_time, plant.safe_input)

    def change(self, truth: TrueMotion) -> None:
        """From the last sample on the true motion is another."""
        self._motion.change(truth)

    def command(self, command: Command, t: float) -> Verdict:
        """See `Shield.command`."""
        return self._shield.command(command, t)

    def backup(self, backup: Backup) -> Verdict:
        """See `Shield.backup`."""
        return self._shield.backup(backup)

    def override(self, override: Override, t: float) -> HandVerdict:
        """See `Shield.override`."""
        return self._shield.override(override, t)

    @property
    def acting(self) -> np.ndarray:
        """The input that acts, (m,)."""
        return self._shield.acting

    @property
    def hand(self) -> Hand:
        """Who drives it by hand, and why nobody does any more."""
        return self._shield.hand

    def look(self, t: float) -> PlantState:
        """What `sample` would say at t; nothing changes. Raises as `sample` does."""
        # Shared is what keeps nothing.
        shared = {id(one): one for one in (self._shield.plant, self._motion.truth, self._way_back)}
        return copy.deepcopy(self, shared).sample(t)

    def sample(self, t: float) -> PlantState:
        """See `Shield.sample`. Raises `PlantError`: the true motion cannot be followed to t."""
        self._shield.advance(t, self._motion)
        x = self._motion.read(t)
        state = self._shield.sample(t, x)
        self._shield.renew(t, x, self._motion)
        return state
