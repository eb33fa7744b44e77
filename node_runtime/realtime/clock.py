"""The common clock: CLOCK_MONOTONIC, which has the same zero for all processes of a machine."""

from __future__ import annotations

import time


def now() -> float:
    """Return seconds on the monotonic clock."""
    return time.monotonic_ns() * 1e-9


def now_ns() -> int:
    """Return nanoseconds on the monotonic clock."""
    return time.monotonic_ns()


def sleep_until(deadline: float) -> None:
    """Sleep until `now()` reaches `deadline`, in seconds; return at once if it has passed.

    `time.sleep` is an absolute clock_nanosleep since Python 3.11, so interruptions do not accumulate.
    """
    remaining = deadline - now()
    if remaining > 0.0:
        time.sleep(remaining)
