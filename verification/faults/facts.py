"""The figures of one run."""

from __future__ import annotations

from typing import Literal

import msgspec


class Replayed(msgspec.Struct, frozen=True):
    """Outcome of the replay of the run's log."""

    verdict: Literal["exact", "exact, with gaps", "nothing in it", "DIFFERS", "no replay"]
    """"nothing in it": the recorder was killed before it wrote its first half second."""
    reason: str = ""
    """The difference in words, if the replay is not exact."""


class Facts(msgspec.Struct, kw_only=True):
    """The figures of one run, in seconds; None where a figure does not exist."""

    violations: int
    """Samples of the true plant outside X, or inputs outside U, by more than 1e-6 of a half-width, from the
    fault on."""
    deepest: float
    """Largest violation, as a share of the half-width of X or U, from the fault on."""
    J: float
    """Sum of the stage costs, weights per second, over the run's first `samples`."""
    samples: int
    ticks: int
    late: int
    """Ticks of the controller and samples of the plant that were late or skipped, those of a process that was itself
    hurt left out."""
    late_by_machine: int
    """Of these, the number during which an idle loop of the highest priority was late too."""
    tick_p99_ms: float | None
    """99th percentile over the ticks during which the machine itself did not stall."""
    sources: list[str]
    """Sources of the input after the fault, in order."""
    plan_s: float
    """Time for which the plant followed the last plan, and after that its safe input."""
    safe_s: float
    ready_after: float | None
    """From the fault until the last killed process published again, or a link was open again."""
    control_after: float | None
    """From that moment until fresh commands drove the plant; 0 if they never ceased; None if they never came."""
    burst: int
    """Most steps that the controllers began within one period, by their own stamps: a plant that was itself without a
    core finds at once what was sent one by one."""
    foreign_commands: int
    """Commands of a stranger that the plant used."""
    foreign_states: int
    """Ticks that used a stranger's state."""
    samples_made: int
    """Labelled samples that the last controller made."""
    samples_held: int | None
    """Of these, the number that the trainer held in the end."""
    readable_gap: float | None
    """From the last readable message of the log to the moment its recorder was killed; None if no log is readable."""
    log_missing: int
    """Ticks that the controller made while the recorder was well and that the log lacks."""
    replay: Replayed
    forged_adopted: int
    """Sets of hidden weights of the attacker that were adopted."""
    rolled_back: int
    errors: list[float]
    """|h_hat - h| of each labelled tick of the first controller, in order; 0 for a tick without a label."""
    fault_tick: int
    """Number of these before the fault."""
    view_at_end: str
    """The live view's line about the recorder when the run ends."""
    log_time_off: float | None
    """Seconds by which the log's own times exceed those of its ticks."""
    verdicts: dict[str, int]
    """Verdicts on hidden weights, with counts."""
    counted: dict[str, int]
    """Counts of bad messages, by process and topic, and of overflows."""
    said: list[str]
    """Notes of the processes' health, each once."""
    extra: dict[str, float]
    """Figures that the fault itself measured."""
    not_led: int = 0
    """Ticks without a reference, after the first tick with one."""
