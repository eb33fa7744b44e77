"""A hand on the switch: an input that a person commands, while they say so and the plant stays in X. No clock, no I/O.

The messages of one sender are one intention. Its message number 0 begins it and takes over from whoever's was there,
those behind it renew it or give another input. It ends when it says so itself, when another begins, when the lease of
its last message is over, when the state is another one (a new origin), and where the plant would leave X. What ended
does not come back: a renewal that arrives too late is refused, also by a gateway that was started again meanwhile.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from lbmpc.plants import Description
from plant_sim.way_back import Ahead, WayBack
from protocol.messages import Override

HandVerdict = Literal["ok", "out of order", "ended", "no model"]

LEASE_OVER = "the lease is over"
NO_LONGER = "no longer driven by hand: "
"""So a gateway's health begins to say why, in `Hand.ended`."""


class Hand:
    """Whose input acts, and until when. Times in seconds."""

    def __init__(self, plant: Description, way_back: WayBack | None):
        """way_back: what is asked at every sample; None: nobody may take over by hand."""
        self._plant, self._way_back = plant, way_back
        self._said: Override | None = None
        self._wanted = np.zeros(plant.m)
        self._u: np.ndarray | None = None
        self._ahead: Ahead | None = None
        self.until = np.inf
        """When it is over if nothing else is said; infinite where nobody has the hand on it."""
        self._given_back: str | None = None
        self.ended = ""
        """Why their input acts no more, for a person; empty while it does, and where they gave it back."""

    @property
    def run_id(self) -> str:
        """Of the last who said anything; empty before that."""
        return "" if self._said is None else self._said.run_id

    @property
    def acts(self) -> bool:
        """Whether somebody has taken over, from the next sample on at the latest."""
        return self.until < np.inf and self._given_back is None

    def take(self, override: Override, t: float) -> HandVerdict:
        """What arrived at time t, with the plant's dimensions (`check_dimensions`)."""
        last = self._said
        own = last is not None and override.run_id == last.run_id
        if self._way_back is None:
            return "no model"
        if last is not None and own and override.seq < last.seq:
            return "out of order"
        if not own and override.seq != 0:
            return "ended"
        if override.mode == "auto":
            if self.acts:
                self.until, self._given_back = t, "" if own else f"{override.run_id} gave it back"
            self._said, self.ended = override, ""
            return "ok"
        if own and not self.acts:
            return "ended"
        self._said, self.ended, self._given_back = override, "", None
        self._wanted, self.until = self._plant.within(override.u), t + override.lease
        return "ok"

    def end(self, why: str) -> None:
        """From now on it is for others to say what acts."""
        if self.until < np.inf:
            self._u, self._ahead, self._given_back, self.until, self.ended = None, None, None, np.inf, why

    def input(self, t: float) -> np.ndarray | None:
        """The input, (m,), that acts by hand at time t; None: none does."""
        if t >= self.until:
            self.end(LEASE_OVER if self._given_back is None else self._given_back)
        return self._u

    def look(self, x: np.ndarray | None, acting: np.ndarray, written: Sequence[np.ndarray] = ()) -> None:
        """At a sample: what was said since the last acts from now on, unless there is no way back inside X behind it.

        x: the state, (d,), plant units; None: it was not measured, and what was predicted stands for it. acting: the
        input until now, (m,). written: those that are on their way through the plant's dead time, one a period, the
        oldest first.
        """
        way_back = self._way_back
        if not self.acts or way_back is None:
            return
        now = self._ahead if x is None else way_back.of(x)
        if now is None:
            self.end("the state is not measured")
            return
        reached = way_back.reached(acting, self._wanted)
        first, *others = (*written, reached)
        self._ahead = there = way_back.after(now, first)
        for u in others:
            there = way_back.after(there, u)
        if why := way_back.lost(there, reached):
            self.end(why)
        else:
            self._u = self._wanted
