"""What the live view shows of a run at one moment."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from lbmpc.plants import Description
from node_runtime.config.sections import Config

Weight = Literal["note", "good", "bad"]


@dataclass(frozen=True)
class Gauge:
    """One state or input against its bounds, in the plant's own units."""

    name: str
    value: float | None
    low: float
    high: float
    target: float
    scale: float
    """What counts as 1: the half-width where both bounds are finite."""


@dataclass(frozen=True)
class ProcessRow:
    """One process as it says itself, and how long ago it said so."""

    name: str
    status: str
    """Of its Health; "not heard of", "not configured", "silent" or "ended" where there is none."""
    note: str
    counters: dict[str, int]


@dataclass(frozen=True)
class Event:
    """One line for a person."""

    at: float
    """Seconds since the first command; negative before it."""
    text: str
    weight: Weight = "note"


@dataclass
class Snapshot:
    """All that the live view shows at one moment. The monitor counts in one, and gives copies."""

    config: Config
    plant: Description
    seconds: float
    phase: str = ""
    """What is being waited for, e.g. "the trainer" or "the plant"; empty while the run goes on."""
    elapsed: float | None = None
    """Seconds since the first command, None before it."""
    states: tuple[Gauge, ...] = ()
    inputs: tuple[Gauge, ...] = ()
    source: str = ""
    """What drives the plant: hold, command, plan, safe, manual."""
    ticks: int = 0
    measured_rate: float | None = None
    late: int = 0
    skipped: int = 0
    mode: str = ""
    sensor_faults: dict[str, str] = field(default_factory=dict)
    """What is wrong with sensors that are not believed, in words, by the names of their states."""
    fallback: int = 0
    slack: float = 0.0
    slack_row: str = ""
    """Which state constraint gives way, as "y at step 3"."""
    soft: int = 0
    set_margin: float | None = None
    """To the boundary of the certified sets, negative outside; None where none are in force, or no state."""
    set_piece: int = -1
    outside: int = 0
    """Ticks outside of them."""
    reference: dict[str, float] = field(default_factory=dict)
    """Where outputs should be now, by name; empty where there are none."""
    target_status: str = "none"
    solve_ms: tuple[float, float] | None = None
    """p50 and p99 of the recent ticks."""
    tick_ms: tuple[float, float] | None = None
    prediction_error: float | None = None
    """Mean of the last second."""
    counts: float | None = None
    """What of the network, or of the constant beside it, counts in the prediction of some state: the most; None where
    nothing weighs it."""
    adds_nothing: bool = False
    """Whether it has been nearly nothing for seconds."""
    noise: dict[str, float] | None = None
    """Standard deviation of what is measured as the estimator found it, by the names of states; None where it was
    told."""
    trend: tuple[float, ...] = ()
    """Mean prediction error of each second so far, the newest last."""
    weights_version: int = -1
    adopted: int = 0
    refused: int = 0
    rolled_back: int = 0
    loss: tuple[float, float] | None = None
    """Of the last training: before, after."""
    samples: int = 0
    processes: tuple[ProcessRow, ...] = ()
    bad_messages: int = 0
    events: tuple[Event, ...] = ()
