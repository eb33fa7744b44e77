"""What one run came to, in figures."""

from __future__ import annotations

from typing import Literal

import msgspec


class Replayed(msgspec.Struct, frozen=True):
    """What became of replaying the run's log."""

    verdict: Literal["exact", "exact, with gaps", "nothing in it", "DIFFERS", "no replay"]
    """"nothing in it": the recorder was killed before it had written its first half second."""
    reason: str = ""
    """In words, where it is not exact."""


class Facts(msgspec.Struct, kw_only=True):
    """One run in figures. Seconds throughout; None where there is nothing of the kind."""

    violations: int
    """Samples of the true plant outside X, or inputs outside U, by more than 1e-6 of a half-width, from the
    fault on."""
    deepest: float
    """How far outside at most, as a share of the half-width of X or U, from the fault on."""
    J: float
    """Sum of the stage costs, weights per second, over the run's first `samples`."""
    samples: int
    ticks: int
    late: int
    """Ticks of the controller and samples of the plant that were late or skipped, those of a process that was itself
    hurt left out."""
    late_by_machine: int
    """Of these, how many while an empty loop above everything was late too."""
    tick_p99_ms: float | None
    """Of the ticks during which the machine itself did not stand still."""
    sources: list[str]
    """What drove the plant after the fault, one after the other."""
    plan_s: float
    """For how long it followed the last plan, and after that its safe input."""
    safe_s: float
    ready_after: float | None
    """From the fault until the last process that was killed spoke again, or a link was there again."""
    control_after: float | None
    """From that moment until fresh commands drove the plant again; 0 when they never ceased; None: they never came."""
    burst: int
    """Most steps that the controllers began within one period, by their own stamps: a plant that was itself without a
    core finds at once what was sent one by one."""
    foreign_commands: int
    """Commands that the plant took from anybody but a controller of this run."""
    foreign_states: int
    """Ticks that used a state of anybody but the plant of this run."""
    samples_made: int
    """Labelled samples that the last controller made."""
    samples_held: int | None
    """Of them, how many the trainer held in the end."""
    readable_gap: float | None
    """From the last message of the log that can be read to the moment its recorder was killed; None: no log can be."""
    log_missing: int
    """Ticks that the controller made while the recorder was well and that are not in the log."""
    replay: Replayed
    forged_adopted: int
    """Sets of hidden weights of the attacker that were adopted."""
    rolled_back: int
    errors: list[float]
    """|h_hat - h| of each labelled tick of the first controller, in order; 0 for a tick without a label."""
    fault_tick: int
    """How many of these came before the fault."""
    view_at_end: str
    """What the live view's line about the recorder says when the run ends."""
    log_time_off: float | None
    """How much longer the log's own times are than the ticks that they belong to."""
    verdicts: dict[str, int]
    """On hidden weights, how often each."""
    counted: dict[str, int]
    """Bad messages counted, by process and topic, and what overflowed."""
    said: list[str]
    """Notes of the processes' health, each once."""
    extra: dict[str, float]
    """What the fault itself measured."""
    not_led: int = 0
    """Ticks without a reference, after the first that had one."""
