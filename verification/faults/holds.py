"""Checks of a run against one without the fault. Each returns what failed, or None."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from protocol.messages import counter_name
from verification.faults.facts import Facts

Held = Callable[[Facts, Facts], str | None]
"""(the run, the run with the same seed and no fault) -> what failed, or None."""

CONTROL_BACK_S = 1.0
READABLE_S = 0.6
"""Half a second between flushes, a state every 50 ms, and the time of a flush."""
COST_SHARE = 0.05
PREDICTS_SHARE, PREDICTS_FLOOR = 1.5, 3e-5
"""Two runs without an attack differ too. The floor is that of the trial: 0.003 of the output scale."""
SAYS_SO = re.compile("NOT LOGGED|silent|ended")
EXACT = ("exact", "exact, with gaps")
"""Replays in which no command differs."""
OBEYED = {
    "plant/state": "controller",
    "controller/command": "plant",
    "controller/backup": "plant",
    "controller/samples": "trainer",
    "controller/output_weights": "trainer",
    "trainer/hidden_weights": "controller",
}
"""Topics that a process acts on, and that process. Other topics are only shown and logged."""


def constraints(run: Facts, calm: Facts) -> str | None:
    """The true plant keeps its constraints wherever the run without a fault keeps them."""
    if run.violations > calm.violations:
        return f"{run.violations} samples outside, {calm.violations} without the fault"
    return None


def control_back(run: Facts, calm: Facts) -> str | None:
    """Fresh commands drive the plant within a second after the process or the link is back."""
    if run.control_after is None:
        return "control did not come back"
    if run.control_after > CONTROL_BACK_S:
        return f"control came back {run.control_after:.2f} s after the process or link"
    return None


def punctual(run: Facts, calm: Facts) -> str | None:
    """No tick is late in an unhurt process, except while the machine itself stalled."""
    late = run.late - run.late_by_machine
    return f"{late} late" if late > 0 else None


def still_led(run: Facts, calm: Facts) -> str | None:
    """The reference that was given is in force, also after the controller's return."""
    return f"{run.not_led} ticks without the reference" if run.not_led else None


def no_burst(run: Facts, calm: Facts) -> str | None:
    """At most two steps begin within a period: the late one and the next."""
    return f"{run.burst} steps of the controller within a period" if run.burst > 2 else None


def plan_then_safe(run: Facts, calm: Facts) -> str | None:
    """The plant follows the rest of the plan, then its safe input, in this order."""
    order = [source for source in run.sources if source != "command"]
    first = order[: order.index("safe") + 1] if "safe" in order else order[:1]
    return None if first in ([], ["plan"], ["plan", "safe"]) else f"driven by {', '.join(run.sources)}"


def merged(run: Facts, calm: Facts) -> str | None:
    """The trainer has every sample once."""
    if run.samples_held is None:
        return "the trainer did not say how many samples it has"
    if run.samples_held != run.samples_made:
        return f"the trainer holds {run.samples_held} of {run.samples_made} samples"
    return None


def control_kept(run: Facts, calm: Facts) -> str | None:
    """The loop continues: fresh commands never ceased, except while the machine itself stalled."""
    if run.plan_s and not run.late_by_machine:
        return f"no fresh command for {run.plan_s:.2f} s"
    return None


def readable(run: Facts, calm: Facts) -> str | None:
    """All but the last half second of the log is readable, and the readable part replays."""
    if run.readable_gap is None:
        return "the log cannot be read"
    if run.readable_gap > READABLE_S:
        return f"the last {run.readable_gap:.2f} s before the kill cannot be read"
    if run.log_missing:
        return f"{run.log_missing} ticks before the last second are not in the log"
    return None if run.replay.verdict in (*EXACT, "nothing in it") else run.replay.reason


def replays(run: Facts, calm: Facts) -> str | None:
    """The log reproduces every command, byte for byte."""
    return None if run.replay.verdict in EXACT else run.replay.reason


def none_obeyed(run: Facts, calm: Facts) -> str | None:
    """No command and no state of a stranger was used."""
    if run.foreign_commands or run.foreign_states:
        return f"{run.foreign_commands} commands and {run.foreign_states} states of strangers obeyed"
    return None


def all_counted(run: Facts, calm: Facts) -> str | None:
    """Each message to a process that obeys its topic is in that process's counters, and no other message is."""
    for topic, process in OBEYED.items():
        sent = int(run.extra.get(f"sent {topic}", 0))
        found = {name: count for name, count in run.counted.items() if name.startswith(f"{process} ")}
        before = f"{process} {counter_name('bad', topic)}_"
        reasons = {name.removeprefix(before): n for name, n in found.items() if name.startswith(before)}
        bad = sum(reasons.values())
        # Messages of the run's own trainer may be refused too. The controller's first
        # command may come before it has received a state.
        own = ("refused", "for_another_run", "superseded", "answers_no_sample")
        surely = bad - sum(reasons.get(reason, 0) for reason in own)
        # A full mailbox drops its oldest message, from any sender.
        dropped = found.get(f"{process} {counter_name('overflow', topic)}", 0)
        if not surely <= sent <= bad + dropped:
            return f"{sent} sent to {topic}, {bad} counted by the {process}, {dropped} dropped"
    return None


def refused_on_both_sides(run: Facts, calm: Facts) -> str | None:
    """No stranger connected or exceeded its role; the stranger was told why, and the router counts it."""
    tries, refused = run.extra.get("tries", 0), run.extra.get("refused", 0)
    if not tries or refused < tries:
        return f"{tries - refused:g} of {tries:g} tries were let in"
    if not any(name.startswith("said: ") for name in run.extra):
        return "the stranger was not told why"
    if not any(
        name.startswith(("router bad_tls_link_refused", "router bad_from_trainer")) for name in run.counted
    ):
        return "the router did not say why"
    return None


def weights_refused(run: Facts, calm: Facts) -> str | None:
    """Every forged set was refused, was rolled back soon, or predicts as well as the trainer's sets.

    The trial admits a set that predicts the controller's own samples no worse. The set in force after that must
    predict later samples no worse than without the attack.
    """
    if not run.extra.get("sent trainer/hidden_weights"):
        return "nothing was forged"
    if run.forged_adopted <= run.rolled_back:
        return None
    error, without = (_rms(one.errors[run.fault_tick :]) for one in (run, calm))
    if error > PREDICTS_SHARE * without + PREDICTS_FLOOR:
        return (
            f"{run.forged_adopted} forged sets adopted, {run.rolled_back} rolled back; error of the prediction "
            f"{error:.2g}, {without:.2g} without"
        )
    return None


def _rms(errors: list[float]) -> float:
    return math.sqrt(sum(error * error for error in errors) / max(1, len(errors)))


def whole(run: Facts, calm: Facts) -> str | None:
    """The log has everything, and replays byte for byte."""
    if run.log_missing:
        return f"{run.log_missing} ticks are not in the log"
    return None if run.replay.verdict == "exact" else run.replay.reason


def view_says(run: Facts, calm: Facts) -> str | None:
    """At the end of the run the live view says that nothing is logged."""
    return None if SAYS_SO.search(run.view_at_end) else f"the live view shows {run.view_at_end!r}"


def view_said(run: Facts, calm: Facts) -> str | None:
    """The recorder said that nothing was logged for a while, and is well at the end."""
    if not any("NOT LOGGED" in text for text in run.said):
        return "the recorder never said it"
    return f"the live view still shows {run.view_at_end!r}" if SAYS_SO.search(run.view_at_end) else None


def log_time(run: Facts, calm: Facts) -> str | None:
    """The log's own times continue unchanged."""
    if run.log_time_off is None or abs(run.log_time_off) > 1.0:
        return f"the log's times are {run.log_time_off} s off"
    return None


def as_fast(run: Facts, calm: Facts) -> str | None:
    """The tick's p99 is less than doubled."""
    if run.tick_p99_ms is None or calm.tick_p99_ms is None:
        return "no tick was timed"
    if run.tick_p99_ms >= 2.0 * calm.tick_p99_ms:
        return f"tick p99 {run.tick_p99_ms:.1f} ms, {calm.tick_p99_ms:.1f} ms without"
    return None


def as_good(run: Facts, calm: Facts) -> str | None:
    """The closed loop costs at most 5 % more."""
    if run.J > (1.0 + COST_SHARE) * calm.J:
        return f"J {run.J:.3g}, {calm.J:.3g} without"
    return None
