"""Manual override: an input that a person commands, valid while it is renewed and the plant stays in X. No clock, no
I/O.

The messages of one sender are one intention. Message number 0 starts it and replaces any earlier intention; later
messages renew it or change the input. It ends when its sender ends it, when another one starts, when the lease of its
last message expires, when the state is set anew, and when the plant would leave X. An ended intention does not resume:
late renewals are refused, also by a gateway that was restarted meanwhile.
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
NO_LONGER = "no longer under manual control: "
"""Start of the text in a gateway's health that gives the reason in `Hand.ended`."""


class Hand:
    """The present manual input and its end. Times are in seconds."""

    def __init__(self, plant: Description, way_back: WayBack | None):
        """way_back: the check at every sample; None if manual inputs are not allowed."""
        self._plant, self._way_back = plant, way_back
        self._said: Override | None = None
        self._wanted = np.zeros(plant.m)
        self._u: np.ndarray | None = None
        self._ahead: Ahead | None = None
        self.until = np.inf
        """When the override ends without further messages; infinite without an override."""
        self._given_back: str | None = None
        self.ended = ""
        """Why the override ended, for a person; empty while it is active and after its sender ended it."""

    @property
    def run_id(self) -> str:
        """run_id of the last sender; empty before the first message."""
        return "" if self._said is None else self._said.run_id

    @property
    def acts(self) -> bool:
        """Whether an override is active, at the latest from the next sample on."""
        return self.until < np.inf and self._given_back is None

    def take(self, override: Override, t: float) -> HandVerdict:
        """Handle a message that arrived at time t and has the plant's dimensions (`check_dimensions`)."""
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
        """End the override."""
        if self.until < np.inf:
            self._u, self._ahead, self._given_back, self.until, self.ended = None, None, None, np.inf, why

    def input(self, t: float) -> np.ndarray | None:
        """Return the manual input, (m,), at time t; None without one."""
        if t >= self.until:
            self.end(LEASE_OVER if self._given_back is None else self._given_back)
        return self._u

    def look(self, x: np.ndarray | None, acting: np.ndarray, written: Sequence[np.ndarray] = ()) -> None:
        """Apply the last requested input from this sample on, if the plant can be brought back inside X afterwards.

        Args:
            x: the state, (d,), in plant units; None if it was not measured, which uses the predicted state.
            acting: the present input, (m,).
            written: inputs within the plant's dead time, one per period, oldest first.
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
