"""The one clock: CLOCK_MONOTONIC, the same zero for all processes of a machine since boot."""

from __future__ import annotations

import time


def now() -> float:
    """Seconds on the monotonic clock."""
    return time.monotonic_ns() * 1e-9


def now_ns() -> int:
    """Nanoseconds on the monotonic clock."""
    return time.monotonic_ns()


def sleep_until(deadline: float) -> None:
    """Sleep until `now()` reaches `deadline`, in seconds; returns at once when it has passed.

    `time.sleep` is an absolute clock_nanosleep since Python 3.11, so that an interruption does not add up.
    """
    remaining = deadline - now()
    if remaining > 0.0:
        time.sleep(remaining)
