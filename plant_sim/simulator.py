"""The simulated plant in virtual time: its true motion, driven piecewise by whatever acts on its input."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from operator import mul
from typing import Literal

import numpy as np

from lbmpc.plants import Description, TrueMotion
from plant_sim.watchdog import Orders, Standby
from protocol.messages import Backup, Command, InputSource, Piece, PlantState

CommandVerdict = Literal["ok", "wrong period", "foreign", "stale", "answers no sample"]


@dataclass(frozen=True, slots=True, eq=False)
class _Segment:
    """A stretch of time, in seconds, under one input; None while the plant is held."""

    duration: float
    u: np.ndarray | None
    source: InputSource


class PlantSim:
    """The plant between its commands and its samples. No clock: every time is an argument, in seconds.

    It is held at x0 until the first command that answers one of its own samples, and moves from then on.
    Commands act from their arrival; `sample` integrates up to its own time, so a command may be handed in
    late as long as its arrival time is right. The same calls give the same numbers.
    """

    def __init__(
        self,
        plant: Description,
        truth: TrueMotion,
        period: float,
        x0: np.ndarray,
        plan_patience: float,
        run_id: str,
    ):
        """x0: (d,), plant units. plan_patience: periods without a command before the plan goes on."""
        self.plant = plant
        self.period = period
        self.run_id = run_id
        self._patience = plan_patience
        self._truth = truth
        self._x = np.array(x0, dtype=float)
        self._first: float | None = None
        self._t = -math.inf
        self._seq = -1
        self._orders: Orders | None = None
        self._pending: list[Orders] = []
        self._standby: dict[int, Standby] = {}
        self._memo: dict[tuple[bytes, bytes, float], np.ndarray] = {}

    @property
    def moving(self) -> bool:
        """False while held at x0."""
        return self._orders is not None

    def change(self, truth: TrueMotion) -> None:
        """From the last sample on this is the true motion: an experiment with a plant that drifts."""
        self._truth = truth
        self._memo = {}

    def command(self, command: Command, t: float) -> CommandVerdict:
        """Let `command` act from time t on, or from the last sample if t lies before it.

        It must have the plant's dimensions (`check_dimensions`). It is refused when its period is not the
        plant's, when it answers another plant's sample or none, and when it answers a sample so old that the plan had
        to take over already. A controller that hears no states goes on with a plan that keeps only the nominal model
        in X; the backup policy that the plant has is better, and it has its own sensors.
        """
        if not math.isclose(command.period, self.period, rel_tol=1e-6):
            return "wrong period"
        if command.state_seq < 0:
            return "answers no sample"
        if command.state_run_id != self.run_id or command.state_seq > self._seq or self._first is None:
            return "foreign"
        age = t - (self._first + command.state_seq * self.period)
        if age > (1.0 + self._patience) * self.period:
            return "stale"
        at = max(t, self._t, self._pending[-1].arrived if self._pending else -math.inf)
        self._pending.append(Orders(self.plant, command, at, self._patience))
        return "ok"

    def backup(self, backup: Backup) -> CommandVerdict:
        """Keep `backup` ready for when commands stop coming.

        It must have the plant's dimensions. It is refused unless it belongs to one of the last commands: only these
        say when its periods begin.
        """
        if not math.isclose(backup.period, self.period, rel_tol=1e-6):
            return "wrong period"
        known = [order for order in (self._orders, *self._pending) if order is not None]
        for order in known:
            if (order.run_id, order.seq) == (backup.run_id, backup.seq):
                self._standby[backup.seq] = Standby(backup, order.arrived)
                return "ok"
        return "stale" if any(order.run_id == backup.run_id for order in known) else "foreign"

    def sample(self, t: float) -> PlantState:
        """x(t) and what acted since the sample before; t must rise by about whole periods.

        `applied` is the time average of the input over the last period, that input itself when only one
        acted, and None when the plant was held for a part of it or the last sample is not one period ago.
        `source` is what acted just before t.

        Raises:
            PlantError: the true motion cannot be followed to t.
        """
        applied: list[float] | None = None
        source: InputSource = "hold"
        if self._first is None:
            self._first, self._t = t, t
        segments, orders, self._x = self._motion(t)
        if segments:
            source = segments[-1].source
            applied = self._applied(segments)
        moves = groupby(segments, key=lambda segment: None if segment.u is None else segment.u.tolist())
        pieces = [Piece(sum(s.duration for s in same), u) for u, same in moves if u is not None]
        self._orders = orders
        self._pending = [order for order in self._pending if order.arrived > t]
        if orders is not None:
            # Of older commands nothing is followed any more, but for the one before the last: see `_drive`.
            self._standby = {seq: standby for seq, standby in self._standby.items() if seq >= orders.seq - 1}
        self._t = t
        self._seq = max(self._seq + 1, round((t - self._first) / self.period))
        self._memo = {}
        return PlantState(
            run_id=self.run_id,
            seq=self._seq,
            t=t,
            x=self._x.tolist(),
            applied=applied,
            pieces=pieces if applied is None or len(pieces) > 1 else [],
            source=source,
            command_seq=-1 if orders is None else orders.seq,
        )

    def prepare(self, t: float) -> None:
        """Integrate ahead to the next sample at t; `sample` is then quick unless another command arrives.

        Changes nothing else. Raises `PlantError` like `sample`.
        """
        self._motion(t)

    def _motion(self, end: float) -> tuple[list[_Segment], Orders | None, np.ndarray]:
        """The segments from the last sample to `end`, the orders that hold from there, and the state there."""
        t, orders, x = self._t, self._orders, self._x
        segments: list[_Segment] = []
        arriving = [order for order in self._pending if order.arrived <= end]
        for order in [*arriving, None]:
            at = end if order is None else order.arrived
            while t < at:
                if orders is None:
                    segments.append(_Segment(at - t, None, "hold"))
                    break
                drive = orders.drive(t, x, self._standby.get(orders.seq) or self._standby.get(orders.seq - 1))
                until = min(drive.until, at)
                # Differences of large times are not exact; the period is.
                duration = self.period if math.isclose(until - t, self.period, rel_tol=1e-6) else until - t
                segments.append(_Segment(duration, drive.u, drive.source))
                x = self._step(x, segments[-1])
                t = until
            t, orders = at, order or orders
        return segments, orders, x

    def _step(self, x: np.ndarray, segment: _Segment) -> np.ndarray:
        """The state, (d,), behind a segment that begins at x."""
        if segment.u is None:
            return x
        key = (x.tobytes(), segment.u.tobytes(), segment.duration)
        if key not in self._memo:
            self._memo[key] = self._truth.step(x, segment.u, segment.duration)
        return self._memo[key]

    def _applied(self, segments: list[_Segment]) -> list[float] | None:
        total = sum(segment.duration for segment in segments)
        # Lists of Python's numbers: in a fast loop numpy would take longer than the motion itself.
        inputs = [segment.u.tolist() for segment in segments if segment.u is not None]
        if len(inputs) < len(segments) or not math.isclose(total, self.period, rel_tol=1e-6):
            return None
        if all(u == inputs[0] for u in inputs):
            return inputs[0]
        shares = [segment.duration / total for segment in segments]
        return [sum(map(mul, shares, entries)) for entries in zip(*inputs, strict=True)]
