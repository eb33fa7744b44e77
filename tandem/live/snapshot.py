"""Content of the live view at one moment."""

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
    """Unit of the gauge: the half-width if both bounds are finite."""


@dataclass(frozen=True)
class ProcessRow:
    """One process as it reports itself, and the age of its report."""

    name: str
    status: str
    """Status of its Health; "no message", "not configured", "silent" or "ended" if there is none."""
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
    """Everything that the live view shows at one moment. The monitor updates one, and gives copies."""

    config: Config
    plant: Description
    seconds: float
    phase: str = ""
    """What the run waits for, e.g. "the trainer" or "the plant"; empty during the run."""
    elapsed: float | None = None
    """Seconds since the first command, None before it."""
    states: tuple[Gauge, ...] = ()
    inputs: tuple[Gauge, ...] = ()
    source: str = ""
    """Source of the input: hold, command, plan, safe, manual."""
    ticks: int = 0
    measured_rate: float | None = None
    late: int = 0
    skipped: int = 0
    mode: str = ""
    sensor_faults: dict[str, str] = field(default_factory=dict)
    """Sensor faults in words, by the names of their states."""
    fallback: int = 0
    slack: float = 0.0
    slack_row: str = ""
    """Violated state constraint, as "y at step 3"."""
    soft: int = 0
    set_margin: float | None = None
    """Distance to the boundary of the certified sets, negative outside; None without sets or without a state."""
    set_piece: int = -1
    outside: int = 0
    """Ticks outside of them."""
    reference: dict[str, float] = field(default_factory=dict)
    """Reference of the outputs now, by name; empty if there is none."""
    target_status: str = "none"
    solve_ms: tuple[float, float] | None = None
    """p50 and p99 of the recent ticks."""
    tick_ms: tuple[float, float] | None = None
    prediction_error: float | None = None
    """Mean of the last second."""
    counts: float | None = None
    """Largest weight of the network, or of the constant beside it, in the prediction of a state; None without them."""
    adds_nothing: bool = False
    """Whether it has been nearly zero for seconds."""
    noise: dict[str, float] | None = None
    """Estimated standard deviation of the measurements, by the names of states; None if it is configured."""
    trend: tuple[float, ...] = ()
    """Mean prediction error of each second so far, the newest last."""
    weights_version: int = -1
    adopted: int = 0
    refused: int = 0
    rolled_back: int = 0
    loss: tuple[float, float] | None = None
    """Loss of the last training: before, after."""
    samples: int = 0
    processes: tuple[ProcessRow, ...] = ()
    bad_messages: int = 0
    events: tuple[Event, ...] = ()
