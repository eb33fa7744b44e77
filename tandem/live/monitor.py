"""Follows a live run: messages off the bus in, what a person wants to see out. `tandem.live.view` draws it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lbmpc.plants import Plant
from node_runtime.bus.inbox import Follower
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.sections import Config
from node_runtime.rejected import RejectedMessages
from protocol import codec, topics
from protocol import messages as m
from run_log.reporting.summary import SOFT

RECENT_TICKS = 1000
RATE_WINDOW_S = 2.0
# Health comes twice a second.
SILENT_S = 2.0
TREND_SECONDS = 40

# Of no use here, and large: not even decoded.
UNSEEN = (topics.KEYFRAME, topics.SETS, topics.OUTPUT_WEIGHTS, topics.SAMPLES)
# Nothing is counted over all of these: a fast loop's are looked at now and then.
ONLY_SHOWN = (topics.PLANT_STATE, topics.COMMAND, topics.TIMING)

Weight = Literal["note", "good", "bad"]


@dataclass(frozen=True)
class Gauge:
    """One state or input against its bounds, in the plant's own units."""

    name: str
    unit: str
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
    """Of its Health; "not heard of", "silent" or "ended" where there is none."""
    note: str
    counters: dict[str, int]


@dataclass(frozen=True)
class Event:
    """One line for a person."""

    at: float
    """Seconds since the first command; negative before it."""
    text: str
    weight: Weight = "note"


@dataclass(frozen=True)
class Snapshot:
    """All that the live view shows at one moment."""

    name: str
    plant: str
    oracle: str
    rate: float
    phase: str
    """What is being waited for, e.g. "the trainer"; empty while the run goes on."""
    elapsed: float | None
    """Seconds since the first command, None before it."""
    seconds: float
    states: tuple[Gauge, ...]
    inputs: tuple[Gauge, ...]
    source: str
    """What drives the plant: hold, command, plan, safe."""
    ticks: int
    measured_rate: float | None
    late: int
    skipped: int
    mode: str
    fallback: int
    slack: float
    slack_row: str
    """Which state constraint gives way, as "y at step 3"."""
    soft: int
    set_margin: float | None
    """To the boundary of the certified sets, negative outside; None where none are in force, or no state."""
    set_piece: int
    outside: int
    """Ticks outside of them."""
    solve_ms: tuple[float, float] | None
    """p50 and p99 of the recent ticks."""
    tick_ms: tuple[float, float] | None
    prediction_error: float | None
    """Mean of the last second."""
    trend: tuple[float, ...]
    """Mean prediction error of each second so far, the newest last."""
    weights_version: int
    adopted: int
    refused: int
    rolled_back: int
    loss: tuple[float, float] | None
    """Of the last training: before, after."""
    samples: int
    processes: tuple[ProcessRow, ...]
    bad_messages: int
    events: tuple[Event, ...] = ()


@dataclass
class _Heard:
    health: m.Health
    at: float


@dataclass
class Monitor:
    """Feed it deliveries (`feed`) and ask for a `snapshot`. Never raises for what arrives."""

    config: Config
    plant: Plant
    seconds: float
    bad: RejectedMessages = field(default_factory=RejectedMessages)
    phase: str = ""
    """See `Snapshot`; whoever supervises says it."""
    first_command: float | None = None
    """When the first command arrived; seconds on the monotonic clock."""
    slots: int = 0
    """Of the controller, up to its newest tick."""

    def __post_init__(self) -> None:
        self._followers: dict[str, Follower] = {}
        self._state: m.PlantState | None = None
        self._input: list[float] | None = None
        self._result: m.TickResult | None = None
        self._weights: m.HiddenWeights | None = None
        self._health: dict[str, _Heard] = {}
        self._ended: set[str] = set()
        self._tick_times: deque[float] = deque(maxlen=RECENT_TICKS)
        self._solve_ms: deque[float] = deque(maxlen=RECENT_TICKS)
        self._tick_ms: deque[float] = deque(maxlen=RECENT_TICKS)
        self._errors: deque[tuple[float, float]] = deque(maxlen=RECENT_TICKS)
        self._trend: deque[float] = deque(maxlen=TREND_SECONDS)
        self._trend_second = 0
        self._first_slot = self._ticks = self._late = self._skipped = self._fallback = self._soft = 0
        self._adopted = self._refused = self._rolled_back = 0
        self._outside = self._outside_now = 0
        self._events: deque[Event] = deque(maxlen=200)
        self._new_events: deque[Event] = deque(maxlen=200)
        self._bad_elsewhere: dict[str, int] = {}

    def feed_all(self, deliveries: Sequence[Delivery]) -> None:
        """Take note of what arrived together, in order; of what is only shown, the newest is enough."""
        newest = {delivery.key: i for i, delivery in enumerate(deliveries)}
        shown = (
            {topic.key(self.config.name) for topic in ONLY_SHOWN} if self.first_command is not None else ()
        )
        for i, delivery in enumerate(deliveries):
            if delivery.key not in shown or newest[delivery.key] == i:
                self.feed(delivery)

    def feed(self, delivery: Delivery) -> m.Message | None:
        """Take note of one message; returns it, or None when it is not shown or must not be believed."""
        topic = topics.topic_of(delivery.key)
        now = delivery.received_ns * 1e-9
        if topic is None:
            self.bad.count("unknown topic", "foreign", delivery.key)
            return None
        if topic in UNSEEN:
            return None
        try:
            message = codec.decode(topic, delivery.payload)
            codec.check_dimensions(topic, message, self.plant.d, self.plant.m)
        except codec.BadMessage as error:
            self.bad.count(topic.name, error.reason, error.detail)
            return None
        follower = self._followers.setdefault(topic.name, Follower(self.config.bus.follow_silence))
        verdict = follower.accept(message.run_id, message.seq, now)
        if verdict != "ok":
            self.bad.count(topic.name, verdict, f"{message.seq} of {message.run_id}")
            return None
        self._take(message, now)
        return message

    def _take(self, message: m.Message, now: float) -> None:
        match message:
            case m.PlantState():
                self._state = message
            case m.Command():
                if self.first_command is None:
                    self.first_command = now
                    self._trend_second = 0
                    self.say("the first command: the run begins", now)
                self._input = message.u
            case m.Tick():
                if not self._ticks:
                    self._first_slot = message.slot
                self.slots = message.slot - self._first_slot + 1
                self._ticks += 1
                self._late += message.late
                self._skipped += message.skipped
                self._tick_times.append(now)
            case m.TickTiming():
                self._solve_ms.append(message.solve_ms)
                self._tick_ms.append(message.tick_ms)
            case m.TickResult():
                self._take_result(message, now)
            case m.HiddenWeights():
                self._weights = message
            case m.Health():
                self._take_health(message, now)
            case _:
                pass

    def _take_result(self, result: m.TickResult, now: float) -> None:
        before = self._result.mode if self._result else "solver"
        self._result = result
        self._fallback += result.mode != "solver"
        self._soft += result.slack > SOFT
        if result.mode != before:
            weight: Weight = "bad" if result.mode != "solver" else "good"
            self.say(
                f"tick {result.seq}: the command comes from {result.mode} ({result.status})", now, weight
            )
        self._take_margin(result, now)
        if result.weights_rolled_back:
            self._rolled_back += 1
            self.say(f"tick {result.seq}: hidden weights {result.weights_rolled_back}", now, "bad")
        if result.weights_outcome == "adopted":
            self._adopted += 1
            self.say(f"tick {result.seq}: hidden weights {result.hidden_version} adopted", now, "good")
        elif result.weights_outcome == "refused":
            self._refused += 1
            self.say(f"tick {result.seq}: hidden weights {result.weights_verdict}", now, "bad")
        if result.prediction_error is not None:
            self._errors.append((now, result.prediction_error))
            self._follow_trend(now)

    def _take_margin(self, result: m.TickResult, now: float) -> None:
        if result.set_margin is None:
            return
        if result.set_margin < 0.0:
            self._outside += 1
            self._outside_now += 1
            if self._outside_now == 1:
                by = f"{-result.set_margin:.2g}"
                text = f"tick {result.seq}: OUTSIDE the certified sets by {by}: nothing is guaranteed"
                self.say(text, now, "bad")
        elif self._outside_now:
            ticks = "tick" if self._outside_now == 1 else "ticks"
            text = f"tick {result.seq}: back in the certified sets after {self._outside_now} {ticks}"
            self._outside_now = 0
            self.say(text, now, "good")

    def _follow_trend(self, now: float) -> None:
        if self.first_command is None:
            return
        second = int(now - self.first_command)
        if second > self._trend_second:
            start = self.first_command + self._trend_second
            values = [error for at, error in self._errors if start <= at < start + 1.0]
            if values:
                self._trend.append(float(np.mean(values)))
            self._trend_second = second

    def _take_health(self, health: m.Health, now: float) -> None:
        self._health[health.process] = _Heard(health, now)
        self._ended.discard(health.process)
        for name, count in health.counters.items():
            if name.startswith("bad ") and f"{health.process} {name}" not in self._bad_elsewhere:
                self.say(f"{health.process}: {name}; not obeyed", now, "bad")
            if name.startswith("bad "):
                self._bad_elsewhere[f"{health.process} {name}"] = count

    def say(self, text: str, now: float, weight: Weight = "note") -> None:
        """Add a line to the events."""
        event = Event(now - self.first_command if self.first_command is not None else -1.0, text, weight)
        self._events.append(event)
        self._new_events.append(event)

    def ended(self, process: str) -> None:
        """Note that a process has died."""
        self._ended.add(process)

    def new_events(self) -> list[Event]:
        """Events since the last call."""
        events = list(self._new_events)
        self._new_events.clear()
        return events

    def status(self, process: str) -> str | None:
        """The status in the newest Health of a process; None when it was not heard of."""
        heard = self._health.get(process)
        return None if heard is None else heard.health.status

    def forget(self, process: str) -> None:
        """A new incarnation was started: what the old one said no longer holds."""
        self._health.pop(process, None)
        self._ended.discard(process)

    def snapshot(self, now: float) -> Snapshot:
        """What there is to see at `now`, seconds on the monotonic clock."""
        plant, result = self.plant, self._result
        recent = [error for at, error in self._errors if at > now - 1.0]
        return Snapshot(
            name=self.config.name,
            plant=plant.name,
            oracle=self.config.controller.oracle,
            rate=self.config.rate,
            phase=self.phase,
            elapsed=None if self.first_command is None else now - self.first_command,
            seconds=self.seconds,
            states=_gauges(
                plant.states,
                plant.units,
                self._state.x if self._state else None,
                plant.x_min,
                plant.x_max,
                plant.x_e,
                plant.x_scale,
            ),
            inputs=_gauges(
                plant.inputs, plant.units, self._input, plant.u_min, plant.u_max, plant.u_e, plant.u_scale
            ),
            source=self._state.source if self._state else "",
            ticks=self._ticks,
            measured_rate=_rate(self._tick_times, now),
            late=self._late,
            skipped=self._skipped,
            mode=result.mode if result else "",
            fallback=self._fallback,
            slack=result.slack if result and result.slack > SOFT else 0.0,
            slack_row=result.slack_row if result else "",
            soft=self._soft,
            set_margin=result.set_margin if result else None,
            set_piece=result.set_piece if result else -1,
            outside=self._outside,
            solve_ms=_percentiles(self._solve_ms),
            tick_ms=_percentiles(self._tick_ms),
            prediction_error=float(np.mean(recent)) if recent else None,
            trend=tuple(self._trend),
            weights_version=result.hidden_version if result else -1,
            adopted=self._adopted,
            refused=self._refused,
            rolled_back=self._rolled_back,
            loss=(self._weights.loss_before, self._weights.loss_after) if self._weights else None,
            samples=self._weights.samples if self._weights else 0,
            processes=tuple(self._row(name, now) for name in topics.PROCESSES),
            bad_messages=self.bad.total + sum(self._bad_elsewhere.values()),
            events=tuple(self._events)[-10:],
        )

    def _row(self, name: str, now: float) -> ProcessRow:
        heard = self._health.get(name)
        if heard is None:
            return ProcessRow(name, "ended" if name in self._ended else "not heard of", "", {})
        status: str = heard.health.status
        if name in self._ended:
            status = "ended"
        elif now - heard.at > SILENT_S:
            status = "silent"
        return ProcessRow(name, status, heard.health.note, heard.health.counters)


def _gauges(
    names: tuple[str, ...],
    units: dict[str, str],
    values: list[float] | None,
    low: np.ndarray,
    high: np.ndarray,
    target: np.ndarray,
    scale: np.ndarray,
) -> tuple[Gauge, ...]:
    return tuple(
        Gauge(
            name,
            units.get(name, ""),
            values[i] if values else None,
            float(low[i]),
            float(high[i]),
            float(target[i]),
            float(scale[i]),
        )
        for i, name in enumerate(names)
    )


def _rate(times: deque[float], now: float) -> float | None:
    recent = [at for at in times if at > now - RATE_WINDOW_S]
    if len(recent) < 2 or recent[-1] <= recent[0]:
        return None
    return (len(recent) - 1) / (recent[-1] - recent[0])


def _percentiles(values: deque[float]) -> tuple[float, float] | None:
    if not values:
        return None
    p50, p99 = np.percentile(np.fromiter(values, float), [50.0, 99.0])
    return float(p50), float(p99)
