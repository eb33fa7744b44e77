"""A monitor that has received every kind of message once."""

from __future__ import annotations

import pytest

from protocol import messages as m
from protocol import topics
from tandem.live.monitor import Monitor
from tests.tandem.live.heard import CONFIG, PLANT, START, command, delivery, health, result, state, tick


@pytest.fixture
def monitor() -> Monitor:
    """Two and a half seconds of a run with every kind of event."""
    seen = Monitor(CONFIG, PLANT, 20.0)
    for process in topics.PROCESSES:
        counters = (
            {"samples": 3, "bad_plant_state_not_finite": 2} if process == "controller" else {"samples": 3}
        )
        seen.feed(delivery(topics.HEALTH[process], health(process, counters, "a note " * 30), START - 1.0))
    for k in range(50):
        at = START + 0.05 * k
        seen.feed(delivery(topics.PLANT_STATE, state(k), at))
        seen.feed(delivery(topics.COMMAND, command(k), at))
        seen.feed(delivery(topics.TICK, tick(k, late=k == 7, skipped=2 * (k == 9)), at))
        mode: m.CommandMode = "shifted_plan" if k == 20 else "solver"
        verdict = {30: "adopted", 35: "refused: not finite"}.get(k, "none")
        slack = 1e-3 if k == 3 else 0.0
        answer = result(k, mode=mode, verdict=verdict, error=10.0 ** -(2 + k / 10), slack=slack)
        seen.feed(delivery(topics.RESULT, answer, at))
        timing = m.TickTiming(
            run_id="c", seq=k, solve_ms=k / 10, tick_ms=k / 5, lateness_ms=0.0, state_age_ms=0.0
        )
        seen.feed(delivery(topics.TIMING, timing, at))
    return seen
