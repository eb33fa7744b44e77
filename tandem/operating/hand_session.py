"""State of a session of manual control or set-points, from the messages of the plant and of others. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lbmpc.plants import Description
from plant_sim.hand import NO_LONGER
from protocol import messages as m
from tandem.operating.set_points import from_words
from tandem.terminal import Refused

LEASE_S, LEASE_PERIODS, LONGEST_LEASE_S = 1.0, 3.0, 60.0


def lease_of(period: float) -> float:
    """Seconds for which a message counts in a loop of this period, in seconds."""
    return min(max(LEASE_S, LEASE_PERIODS * period), LONGEST_LEASE_S)


class Follower:
    """Messages of other processes while a person commands.

    Args:
        run_id: of that person's messages.
        of: their type, `Override` or `Reference`.
    """

    def __init__(self, run_id: str, of: type[m.Override] | type[m.Reference]):
        self._run_id, self._of = run_id, of
        self._said_at: int | None = None
        self.state: m.PlantState | None = None
        """The newest state of the plant."""
        self.begun = False
        """Whether the plant or its controller accepted the message."""
        self.mine = True
        """Whether no other sender has ended the session."""
        self.elsewhere = False
        """Whether another reference ended it."""
        self.told = ""
        """Why the plant is no longer driven manually, as it reports."""

    def said(self) -> None:
        """Note that the message was sent."""
        if self._said_at is None:
            self._said_at = -1 if self.state is None else self.state.seq

    def take(self, message: m.Message) -> str:
        """Process a message; return why the person's message no longer holds, or ""."""
        if message.run_id == self._run_id:
            return ""
        match message:
            case m.PlantState():
                return self._take_state(message)
            case m.TickResult() if message.reference_from == self._run_id:
                self.begun = message.reference_verdict == "taken"
                return "" if self.begun else f"the controller {message.reference_verdict}"
            case m.Health():
                self.told = message.note.partition(NO_LONGER)[2]
            case m.Override(mode="auto", seq=0) if self._said_at is not None:
                return self._lost(f"{message.run_id} returned the plant to the controller")
            case m.Override(mode="manual", seq=0) if self._said_at is not None and self._of is m.Override:
                return self._lost(f"{message.run_id} took over")
            case m.Reference() if self._said_at is not None and self._of is m.Reference:
                self.elsewhere = True
                return self._lost(f"{message.run_id} gave another reference")
        return ""

    def _lost(self, why: str) -> str:
        self.mine = False
        return why

    def _take_state(self, state: m.PlantState) -> str:
        before, self.state = self.state, state
        if self._said_at is None or self._of is m.Reference:
            return ""
        if before is not None and state.run_id != before.run_id:
            return "the gateway was restarted"
        by_hand = state.source == "manual"
        if self.begun and not by_hand:
            return "the plant is no longer under manual control"
        # A message after one sample acts from the next one on, and the sample after that reports it.
        self.begun = self.begun or (by_hand and state.seq > self._said_at + 1)
        return ""


def assignments(texts: Sequence[str], plant: Description) -> dict[str, float]:
    """Parse `u=1.2` and so on, by input. Raises `Refused`."""
    given = from_words(texts)
    for name, value in given.items():
        if name not in plant.inputs:
            known = ", ".join(plant.inputs)
            raise Refused(f"{name}={value:g}: {plant.name} has no input {name!r}; it has {known}")
    return given


def completed(named: Mapping[str, float], plant: Description, acts: Sequence[float] | None) -> np.ndarray:
    """Return the whole input, (m,); inputs without a name keep their value. Raises `Refused` if it is not known."""
    others = [name for name in plant.inputs if name not in named]
    if others and acts is None:
        raise Refused(f"the acting input is not known: give values for {', '.join(others)} too")
    now = dict(zip(plant.inputs, acts or (), strict=False))
    return np.array([named[name] if name in named else now[name] for name in plant.inputs])


def figures(names: Sequence[str], values: Sequence[float] | np.ndarray) -> str:
    """z 0.5000  y 1.6070"""
    return "  ".join(f"{name} {value:.4f}" for name, value in zip(names, values, strict=True))


def clipped(u: np.ndarray, plant: Description) -> str:
    """Name the inputs that the gateway will clip to U; empty if none."""
    acts = np.clip(u, plant.u_min, plant.u_max)
    return "".join(
        f"; outside of U, {plant.inputs[i]} is clipped to {acts[i]:g}" for i in np.flatnonzero(acts != u)
    )


def line(state: m.PlantState, plant: Description, seconds: float) -> str:
    """Describe the acting input and the state for a person; the margin is to the nearest bound of X, in half-widths."""
    x, acts = np.array(state.x), state.acting
    room = -plant.beyond_x(x)
    least = int(np.argmin(room))
    u = "not known" if acts is None else figures(plant.inputs, acts)
    margin = f"margin {room[least]:.3f} ({plant.x_names[least]})"
    return f"{seconds:6.1f} s  {state.source:7}  {figures(plant.states, x)}  |  {u}  |  {margin}"
