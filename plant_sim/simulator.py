"""A true motion as a machine that is read and written, and such a machine with a shield in virtual time."""

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
    """A `Machine` that moves by its truth under the written inputs, at the due times of the calls.

    It stands still at x0 until the first `write`. An input acts after the dead time; until then the previous one acts.
    Times must not decrease.
    """

    def __init__(
        self,
        truth: TrueMotion,
        x0: np.ndarray,
        period: float,
        dead_time: float = 0.0,
        before: np.ndarray | None = None,
    ):
        """x0: (d,), plant units. before: (m,), the input until the first written one acts; needed with a dead time."""
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
        """Change the true motion after the last call, for experiments with a drifting plant."""
        self.truth, self._ahead = truth, None

    def read(self, due: float) -> np.ndarray:
        """Return x at that time, (d,). Raises `PlantError` if the motion cannot be computed."""
        self._first = due if self._first is None else self._first
        self._go(due)
        return self._x

    def write(self, u: np.ndarray, due: float) -> float:
        """Write u, (m,), at that time. Raises as `read` does."""
        self._go(due)
        if self._u is None and self._dead_time:
            self._u = self._before
        self._coming.append((due + self._dead_time, u))
        self._let_act(due)
        return due

    def look_ahead(self) -> None:
        """Compute the next sample now, so that reading it is fast if no other input is written. Raises as `read`."""
        if self._first is None or self._u is None:
            return
        # The tolerance prevents rounding from selecting the present sample.
        samples = math.floor((self._t - self._first) / self._period + 1e-6) + 1
        t = self._first + samples * self._period
        if self._coming and self._coming[0][0] < t:
            # Another input takes over before the sample.
            return
        self._ahead = t, self._after(t)

    def _go(self, t: float) -> None:
        while self._let_act(t):
            pass
        self._move(t)

    def _let_act(self, t: float) -> bool:
        """Switch to the next input if it is due by time t; return whether it was."""
        # A switch within rounding of a sample is moved to the sample.
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
        """Return x(t), (d,), under the present input."""
        assert self._u is not None
        if self._ahead is not None and math.isclose(
            self._ahead[0], t, rel_tol=1e-15, abs_tol=1e-9 * self._period
        ):
            return self._ahead[1]
        # Differences of large times are not exact, so the exact period is used.
        dt = self._period if math.isclose(t - self._t, self._period, rel_tol=1e-6) else t - self._t
        x = np.asarray(self.truth.step(self._x, self._u, dt), dtype=float)
        if x.shape != self._x.shape or not np.isfinite(x).all():
            raise PlantError(
                f"the true motion leads from {self._x.tolist()} to {x.tolist()}, which is not a valid state"
            )
        return x


class PlantSim:
    """A simulated plant in virtual time. It has no clock: every time is an argument.

    The plant is held at x0 until the first command that answers one of its samples. Commands act from their arrival.
    `sample` advances to its own time, so a command may be passed late with its correct time of arrival. Equal calls
    give equal numbers.
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
        """Create a plant.

        Args:
            plant: its description.
            truth: its true motion.
            period: seconds.
            x0: initial state, (d,), in plant units.
            plan_patience: periods without a command before the backup policy or the plan takes over.
            run_id: the incarnation of the plant.
            dead_time: true dead time in seconds, from a command's arrival until it acts. Before the first command acts,
                the safe input acts without its gain.
            way_back: the check of manual inputs; None if they are not allowed.
        """
        self._way_back = way_back
        self._shield = Shield(plant, period, plan_patience, run_id, True, way_back)
        self._motion = Motion(truth, x0, period, dead_time, plant.safe_input)

    def change(self, truth: TrueMotion) -> None:
        """Change the true motion after the last sample."""
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
        """The manual override, and the reason of its end."""
        return self._shield.hand

    def look(self, t: float) -> PlantState:
        """Return what `sample` would return at t, without changing the plant. Raises as `sample` does."""
        # Objects without state are shared instead of copied.
        shared = {id(one): one for one in (self._shield.plant, self._motion.truth, self._way_back)}
        return copy.deepcopy(self, shared).sample(t)

    def sample(self, t: float) -> PlantState:
        """See `Shield.sample`. Raises `PlantError` if the true motion cannot be computed up to t."""
        self._shield.advance(t, self._motion)
        x = self._motion.read(t)
        state = self._shield.sample(t, x)
        self._shield.renew(t, x, self._motion)
        return state
