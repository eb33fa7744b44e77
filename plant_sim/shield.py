"""The rules between controller and plant: accepted commands, acting inputs, samples. No clock and no I/O."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from operator import mul
from typing import Any, Literal, Protocol

import numpy as np

from lbmpc.plants import Description
from plant_sim.hand import Hand, HandVerdict
from plant_sim.orders import Drive, Measure, Orders, Standby, safe_drive
from plant_sim.rate_limit import RateLimit
from plant_sim.way_back import WayBack
from protocol.messages import Backup, Command, InputSource, Override, Piece, PlantState

Verdict = Literal["ok", "wrong period", "foreign", "stale", "answers no sample"]
JITTER = 0.1
"""Largest deviation of the time between two measurements from a period, as a share of it. The error of a label is that
share of the plant's motion in a period."""
MOST_ACTED = 1000
"""Largest number of inputs remembered between samples. It is reached only if no sample can be taken for long."""


class Machine(Protocol):
    """The plant itself. `due` is the time in seconds for which a call is made."""

    def read(self, due: float) -> np.ndarray | None:
        """Return x, (d,), in plant units; None if it cannot be measured."""
        ...

    def write(self, u: np.ndarray, due: float) -> float | None:
        """Apply u, (m,), from now on. Return when it takes effect, in seconds; None if that is not known."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Acting:
    """An input that acts from `since` on. u is None if the plant is held or the input is not known."""

    since: float
    u: np.ndarray | None
    source: InputSource


class Shield:
    """Decides about commands and the plant's input. Every time is an argument, in seconds.

    In a loop, `command`, `backup` and `override` accept messages, `act` or `advance` applies inputs, `sample` ends a
    period, and `renew` starts the next one. Equal calls give equal numbers, for a simulated plant in virtual time as
    for a real one.
    """

    def __init__(
        self,
        plant: Description,
        period: float,
        patience: float,
        run_id: str,
        held: bool,
        way_back: WayBack | None = None,
    ):
        """Create a shield.

        Args:
            plant: the description of the plant.
            period: seconds.
            patience: periods without a command before the backup policy or the plan takes over.
            run_id: the incarnation of the plant.
            held: True for a plant that stands still until the first command that answers one of its samples; otherwise
                the safe input acts.
            way_back: the check of manual inputs; None if they are not allowed.
        """
        self.plant = plant
        self.hand = Hand(plant, way_back)
        # Inputs within the dead time, one per period.
        dead = plant.dead_periods(period)
        self._on_the_way = deque([plant.safe_input] * dead, maxlen=dead)
        self._period, self._patience, self._run_id = period, patience, run_id
        self._held = held
        # Before the first input the actuator has the safe input.
        self._rate_limit = RateLimit(plant, period)
        self._first: float | None = None
        self._t = self._measured = self._acted = -math.inf
        self._seq = -1
        self._orders: Orders | None = None
        self._pending: list[Orders] = []
        self._standby: dict[int, Standby] = {}
        self._until = math.inf
        self._tape = [_Acting(-math.inf, None, "hold")]
        self._written = False
        self._jumped = False
        self._before_jump: Orders | None = None
        self._epoch = 0

    @property
    def moving(self) -> bool:
        """Whether a command was accepted."""
        return self._orders is not None

    @property
    def due(self) -> float:
        """When `advance` must act next without further messages; infinite if never."""
        until = min(self._until, self.hand.until)
        return min(until, self._pending[0].arrived) if self._pending else until

    # -- accepted messages -------------------------------------------------------------------------------

    def command(self, command: Command, t: float) -> Verdict:
        """Let `command` act from time t on, or from the last sample if t lies before it.

        It must have the plant's dimensions (`check_dimensions`). It is refused if its period differs from the plant's,
        if it answers no sample or another plant's, if it answers a sample from before a jump, or if it answers a sample
        so old that the plan has taken over. A controller that receives no states continues with a plan that keeps only
        the nominal model in X; the plant's backup policy is better, because it uses the plant's sensors.
        """
        if not math.isclose(command.period, self._period, rel_tol=1e-6):
            return "wrong period"
        if command.state_seq < 0:
            return "answers no sample"
        if command.state_run_id != self._run_id or command.state_seq > self._seq or self._first is None:
            return "foreign"
        age = t - (self._first + command.state_seq * self._period)
        if command.state_seq < self._epoch or age > (1.0 + self._patience) * self._period:
            return "stale"
        at = max(t, self._t, self._acted, self._pending[-1].arrived if self._pending else -math.inf)
        self._pending.append(Orders(self.plant, command, at, self._patience))
        return "ok"

    def backup(self, backup: Backup) -> Verdict:
        """Store `backup` for the time when commands stop.

        It must have the plant's dimensions. It is refused unless it belongs to one of the last commands, because the
        command determines the start of its periods.
        """
        if not math.isclose(backup.period, self._period, rel_tol=1e-6):
            return "wrong period"
        known = [order for order in (self._orders, *self._pending) if order is not None]
        for order in known:
            if (order.run_id, order.seq) == (backup.run_id, backup.seq) and order is not self._before_jump:
                self._standby[backup.seq] = Standby(backup, order.arrived)
                return "ok"
        return "stale" if any(order.run_id == backup.run_id for order in known) else "foreign"

    def override(self, override: Override, t: float) -> HandVerdict:
        """Start, renew or end a manual input, given a message that arrived at time t. It acts from the next sample on.

        The message must have the plant's dimensions. See `plant_sim.hand` for the end of an override.
        """
        return self.hand.take(override, t)

    def jump(self) -> None:
        """Declare that the next state does not follow from the last inputs: a new origin or a restart.

        The next sample then reports its past input as unknown. The present input acts until a command arrives that
        answers this sample or a later one, or until the patience ends, and then the safe input. Plan and backup policy
        belong to the old state and are dropped. Any thread may call this.
        """
        self._jumped = True

    # -- acting inputs -----------------------------------------------------------------------------------

    def advance(self, t: float, machine: Machine) -> None:
        """Apply all inputs that are due by time t, each at its own time, for a plant in virtual time."""
        while (due := max(self.due, self._acted)) <= t:
            self.act(due, machine)

    def act(self, t: float, machine: Machine) -> None:
        """Apply the input at time t: the newest command, or the input that is due."""
        while self._pending and self._pending[0].arrived <= t:
            self._orders = self._pending.pop(0)
        self._write(self._drive(t, partial(machine.read, t)), t, machine)

    def renew(self, t: float, x: np.ndarray | None, machine: Machine) -> None:
        """Update inputs that depend on the state, at every sample with its x.

        An input that was not written for a period is written again, because a machine's watchdog may expect it, and
        because a failed write must be repeated.
        """
        self.hand.look(x, self.acting, self._on_the_way)
        written, self._written = self._written, False
        acting = self._tape[-1]
        stands = self._held and self._orders is None and acting.source == "hold"
        if (stands or (written and acting.source == "command")) and self.hand.input(t) is None:
            return
        drive = self._drive(t, lambda: x)
        same = acting.u is not None and np.array_equal(drive.u, acting.u)
        if written and same and drive.source == acting.source:
            return
        self._write(drive, t, machine)
        self._written = False

    @property
    def acting(self) -> np.ndarray:
        """The input that acts, (m,); the safe input if it is not known."""
        u = self._tape[-1].u
        return self.plant.within(self.plant.safe_input) if u is None else u

    def rest(self) -> np.ndarray | None:
        """Return the input, (m,), to leave a machine with; None for a machine that can stand still."""
        return None if self._held else self.plant.within(self.plant.safe_input)

    def _drive(self, t: float, measure: Measure) -> Drive:
        if (u := self.hand.input(t)) is not None:
            return Drive(u, "manual", math.inf)
        orders = self._orders
        if orders is None:
            return safe_drive(self.plant, measure, math.inf)
        # Until the backup policy of the last command arrives, that of the previous one is used.
        return orders.drive(t, measure, self._standby.get(orders.seq) or self._standby.get(orders.seq - 1))

    def _write(self, drive: Drive, due: float, machine: Machine) -> None:
        """Write an input within its rate limit. The rest of a limited change follows as soon as the limit allows."""
        reached = self._rate_limit.nearest(drive.u, due)
        since = machine.write(reached, due)
        self._acted = due
        self._written = since is not None
        if self._written:
            self._rate_limit.acts(reached, due)
        self._until = drive.until
        if reached is not drive.u:
            self._until = min(drive.until, self._rate_limit.next_step(due))
        u = None if since is None else reached
        self._tape.append(
            _Acting(max(due if since is None else since, self._tape[-1].since), u, drive.source)
        )
        del self._tape[:-MOST_ACTED]

    # -- samples -----------------------------------------------------------------------------------------

    def sample(self, t: float, x: np.ndarray, measured: float | None = None) -> PlantState:
        """Return the sample of x(t), (d,), with NaN for missing numbers, and of the inputs since the previous sample.

        t must increase by about whole periods. Call `advance` first.

        `applied` is the mean input over the last period, exactly the input if only one acted. It is None if part of it
        is not known or the last sample is not one period ago. `source` is the source of the input just before t.

        measured: when x was measured, if that was not at t.
        """
        measured = t if measured is None else measured
        if self._first is None:
            self._first = self._t = t
        self._seq = max(self._seq + 1, round((t - self._first) / self._period))
        if self._jumped:
            self._begin_epoch(t)
        acted = self._acted_until(t)
        whole = abs(measured - self._measured - self._period) <= JITTER * self._period
        applied = self._average(acted) if whole else None
        # Include the present input even if it has not acted for any time yet.
        pieces = _pieces(acted or [(0.0, self._tape[0])])
        orders = self._orders
        if orders is not None:
            # Policies of older commands are dropped, except the previous one's; see `_drive`.
            self._standby = {seq: one for seq, one in self._standby.items() if seq >= orders.seq - 1}
        self._t, self._measured = t, measured
        if self._on_the_way.maxlen:
            self._on_the_way.append(np.array(applied) if applied else self.acting)
        return PlantState(
            run_id=self._run_id,
            seq=self._seq,
            t=t,
            applied=applied,
            pieces=pieces if applied is None or len(pieces) > 1 else [],
            source=acted[-1][1].source if acted else self._tape[0].source,
            command_seq=-1 if orders is None else orders.seq,
            **measurement(self.plant, x),
        )

    def _begin_epoch(self, t: float) -> None:
        """Reset everything from before t except the acting input."""
        self._jumped, self._epoch, self._measured = False, self._seq, -math.inf
        self._pending, self._standby = [], {}
        self.hand.end("the state is another one")
        if self._orders is not None:
            self._orders = self._before_jump = self._orders.without_plan()
        self._tape = [replace(self._tape[-1], since=t)]

    def _acted_until(self, t: float) -> list[tuple[float, _Acting]]:
        """Return the inputs since the last sample with their seconds, in order. The tape then begins at t."""
        acted, tape = [], []
        for one, end in zip(self._tape, [*(after.since for after in self._tape[1:]), math.inf], strict=True):
            seconds = min(end, t) - max(one.since, self._t)
            if seconds > 0.0:
                # Differences of large times are not exact, so the exact period is used.
                whole = math.isclose(seconds, self._period, rel_tol=1e-6)
                acted.append((self._period if whole else seconds, one))
            if end > t:
                tape.append(one if one.since > t else replace(one, since=t))
        self._tape = tape
        return acted

    def _average(self, acted: list[tuple[float, _Acting]]) -> list[float] | None:
        total = sum(seconds for seconds, _one in acted)
        # Use lists of Python numbers. In a fast loop numpy would take longer than everything else here.
        inputs = [one.u.tolist() for _seconds, one in acted if one.u is not None]
        if len(inputs) < len(acted) or not math.isclose(total, self._period, rel_tol=1e-6):
            return None
        if all(u == inputs[0] for u in inputs):
            return inputs[0]
        shares = [seconds / total for seconds, _one in acted]
        return [sum(map(mul, shares, entries)) for entries in zip(*inputs, strict=True)]


def measurement(plant: Description, x: np.ndarray) -> dict[str, Any]:
    """Return the fields of a `PlantState` for x, (d,). States with NaN are listed as missing."""
    missing = np.isnan(x)
    if not missing.any():
        return {"x": x.tolist()}
    names = [plant.states[i] for i in np.flatnonzero(missing)]
    return {"x": np.where(missing, plant.x_e, x).tolist(), "missing": names}


def _pieces(acted: list[tuple[float, _Acting]]) -> list[Piece]:
    """Return the known inputs up to the end, with equal ones merged. The last one still acts."""
    pieces: list[Piece] = []
    for u, same in groupby(acted, key=lambda part: None if part[1].u is None else part[1].u.tolist()):
        pieces = [] if u is None else [*pieces, Piece(sum(seconds for seconds, _one in same), u)]
    return pieces
