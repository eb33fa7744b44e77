"""A user's two functions as a `Machine`. The loop that calls them continues after failures, and reports them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Literal, TypeVar

import numpy as np

from lbmpc.plants import PlantError
from node_runtime.realtime import clock

log = logging.getLogger(__name__)

Read = Callable[[], np.ndarray]
Write = Callable[[np.ndarray], object]
Call = Literal["read", "write"]
R = TypeVar("R")

SLOW = 0.5
"""Share of a period above which a call counts as slow."""
HANGS_S = 1.0
"""Seconds after which a call that has not returned is reported."""
REMEMBERED_S = 1.0
"""Seconds for which a failed call is reported."""


class NotMeasured(Exception):
    """Raised by `read` when there is no sample this time and nothing is wrong."""


class Guarded:
    """Calls the functions, one at a time, and counts failures. Any thread may call `trouble`."""

    def __init__(
        self, read: Read, write: Write, states: int, period: float, simulated: bool, gaps: bool = False
    ):
        """Wrap two functions.

        Args:
            read, write: the functions.
            states: d.
            period: seconds.
            simulated: each call counts as made at its due time, and exceptions are not caught.
            gaps: whether NaN is allowed for some of the states.
        """
        self._read, self._write, self._gaps = read, write, gaps
        self._states, self._slow, self._simulated = states, SLOW * period, simulated
        self._under_way: tuple[Call, float] | None = None
        self._failures: dict[Call, tuple[str, float]] = {}
        self.counts = dict.fromkeys(("reads_failed", "reads_slow", "writes_failed", "writes_slow"), 0)
        self.due = 0.0
        """The time for which the last call was made, in seconds on the monotonic clock."""
        self.measured = 0.0
        """When the last `read` started."""

    def read(self, due: float) -> np.ndarray | None:
        return self._call("read", due, self._measure)

    def write(self, u: np.ndarray, due: float) -> float | None:
        return self._call("write", due, partial(self._apply, u))

    def trouble(self) -> str:
        """Return what is wrong now, for a person; empty if nothing is."""
        now = clock.now()
        failed = [text for text, at in self._failures.copy().values() if now - at < REMEMBERED_S]
        return "; ".join(filter(None, (*failed, self.hangs)))

    @property
    def hangs(self) -> str:
        """The call that has not returned for a long time, for a person; empty if there is none."""
        under_way = self._under_way
        if under_way is None or clock.now() - under_way[1] < HANGS_S:
            return ""
        return f"{under_way[0]} has not returned for more than {HANGS_S:g} s"

    def _measure(self) -> np.ndarray:
        self.measured = self._now()
        x = np.array(self._read(), dtype=float)
        if x.shape != (self._states,):
            raise ValueError(f"x has the shape {x.shape}, but the plant has {self._states} states")
        gaps = np.isnan(x)
        if not np.isfinite(x).all() and (not self._gaps or gaps.all() or np.isinf(x).any()):
            raise ValueError("x is not finite")
        return x

    def _apply(self, u: np.ndarray) -> float:
        # Pass a copy, because the function may change it.
        self._write(u.copy())
        return self._now()

    def _now(self) -> float:
        return self.due if self._simulated else clock.now()

    def _call(self, name: Call, due: float, function: Callable[[], R]) -> R | None:
        began, self.due = clock.now(), due
        self._under_way = name, began
        try:
            result = function()
        except PlantError:
            raise
        except NotMeasured:
            return None
        except Exception as error:  # user code: after any exception the machine still needs an input
            if self._simulated:
                raise
            self._failed(name, f"{name} failed: {type(error).__name__}: {error}"[:300])
            return None
        finally:
            self._under_way = None
        if clock.now() - began > self._slow:
            self.counts[f"{name}s_slow"] += 1
        return result

    def _failed(self, name: Call, text: str) -> None:
        self.counts[f"{name}s_failed"] += 1
        now = clock.now()
        first, last = self._failures.get(name, ("", -REMEMBERED_S))
        if now - last > REMEMBERED_S:
            first = text
            log.warning("%s; the loop continues, and further failures are only counted", text)
        # Report the first of several failures, so that the text does not change with each.
        self._failures[name] = first, now
