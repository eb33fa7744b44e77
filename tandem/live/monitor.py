"""Follow a live run: messages from the bus in, the content of the display out. `tandem.live.view` draws it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lbmpc.plants import Description
from node_runtime.bus.inbox import Follower
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.sections import Config
from node_runtime.rejected import RejectedMessages
from protocol import codec, topics
from protocol import messages as m
from run_log.reporting.motion import with_outputs
from run_log.reporting.summary import ADDS, ADDS_NOTHING, SOFT
from tandem.live.presence import SILENT_S, Presence
from tandem.live.snapshot import Event, Gauge, ProcessRow, Snapshot, Weight

RECENT_TICKS = 1000
RATE_WINDOW_S = 2.0
TREND_SECONDS = 40
EVENTS = 10
# Seconds until a note says that learning adds nothing.
PATIENCE_S, PATIENCE_TICKS = 3.0, 10

# Not needed here, and large: not decoded.
UNSEEN = (topics.KEYFRAME, topics.SETS, topics.OUTPUT_WEIGHTS, topics.SAMPLES)
# These are only sampled in a fast loop, because nothing is counted over them.
ONLY_SHOWN = (topics.PLANT_STATE, topics.COMMAND, topics.TIMING)


class Monitor:
    """Feed it deliveries (`feed`) and ask for a `snapshot`. Never raises for any message."""

    def __init__(self, config: Config, plant: Description, seconds: float):
        self.config, self.plant, self.seconds = config, plant, seconds
        self.bad = RejectedMessages()
        self.phase = ""
        """See `Snapshot`; the supervisor sets it. While it is empty, a silent plant is waited for."""
        self.first_command: float | None = None
        """When the first command arrived; seconds on the monotonic clock."""
        self.slots = 0
        """State of the controller, up to its newest tick."""
        self._seen = Snapshot(config, plant, seconds)
        self._followers: dict[str, Follower] = {}
        self._plant = Presence(config.period)
        self._x: list[float] | None = None
        self._u: list[float] | None = None
        self._health: dict[str, tuple[m.Health, float]] = {}
        """The newest health by process, and the time of its arrival."""
        self._ended: set[str] = set()
        self._asked_by = ""
        """Sender of the last reference: a repetition renews its lease."""
        self._tick_times: deque[float] = deque(maxlen=RECENT_TICKS)
        self._solve_ms: deque[float] = deque(maxlen=RECENT_TICKS)
        self._tick_ms: deque[float] = deque(maxlen=RECENT_TICKS)
        self._errors: deque[tuple[float, float]] = deque(maxlen=RECENT_TICKS)
        self._trend: deque[float] = deque(maxlen=TREND_SECONDS)
        self._trend_second = self._first_slot = self._outside_now = 0
        self._counted: float | None = None
        """Last time at which h_hat had an effect, or the first with a weight."""
        self._patience = max(PATIENCE_S, PATIENCE_TICKS * config.period)
        self._events: deque[Event] = deque(maxlen=EVENTS)
        self._new_events: deque[Event] = deque(maxlen=200)
        self._bad_elsewhere: dict[tuple[str, str], int] = {}

    def feed_all(self, deliveries: Sequence[Delivery]) -> None:
        """Process messages that arrived together, in order; of messages that are only shown, only the newest."""
        newest = {delivery.key: i for i, delivery in enumerate(deliveries)}
        shown = (
            {topic.key(self.config.name) for topic in ONLY_SHOWN} if self.first_command is not None else ()
        )
        for i, delivery in enumerate(deliveries):
            if delivery.key not in shown or newest[delivery.key] == i:
                self.feed(delivery)

    def feed(self, delivery: Delivery) -> None:
        """Process one message, unless it is not shown or not valid."""
        topic = topics.topic_of(delivery.key)
        now = delivery.received_ns * 1e-9
        if topic is None:
            if not topics.is_user(delivery.key.removeprefix(topics.below(self.config.name, ""))):
                self.bad.count("unknown topic", "foreign", delivery.key)
            return
        if topic in UNSEEN:
            return
        try:
            message = codec.decode(topic, delivery.payload)
            codec.check_dimensions(topic, message, self.plant.d, self.plant.m)
        except codec.BadMessage as error:
            if self.bad.count(topic.name, error.reason, error.detail):
                self.say(f"{error}; ignored", now, "bad")
            return
        follower = self._followers.setdefault(topic.name, Follower(self.config.bus.follow_silence))
        verdict = "ok" if topic.shared else follower.accept(message.run_id, message.seq, now)
        if verdict == "ok":
            self._take(message, now)
        else:
            self.bad.count(topic.name, verdict, f"{message.seq} of {message.run_id}")

    def _take(self, message: m.Message, now: float) -> None:
        seen = self._seen
        match message:
            case m.PlantState():
                if text := self._plant.came(message.run_id, now):
                    self.say(text, now, "good")
                self._take_source(message, now)
                self._x, seen.source = message.x, message.source
            case m.Command():
                if self.first_command is None:
                    self.first_command = now
                    self.say("first command: the run begins", now)
                if seen.source != "manual":
                    self._u = message.u
            case m.Tick():
                if not seen.ticks:
                    self._first_slot = message.slot
                self.slots = message.slot - self._first_slot + 1
                seen.ticks += 1
                seen.late += message.late
                seen.skipped += message.skipped
                self._tick_times.append(now)
            case m.TickTiming():
                self._solve_ms.append(message.solve_ms)
                self._tick_ms.append(message.tick_ms)
            case m.TickResult():
                self._take_result(message, now)
            case m.HiddenWeights():
                seen.loss, seen.samples = (message.loss_before, message.loss_after), message.samples
            case m.Health():
                self._take_health(message, now)

    def _take_source(self, state: m.PlantState, now: float) -> None:
        """Report the begin and the end of manual control."""
        before = self._seen.source
        if before and (state.source == "manual") != (before == "manual"):
            by_hand = state.source == "manual"
            what = "under manual control"
            if not by_hand:
                what = f"no longer under manual control; the input comes from: {state.source}"
            self.say(f"the plant is {what}", now, "note" if by_hand else "good")
        if state.source == "manual":
            self._u = state.acting

    def miss_plant(self, now: float) -> None:
        """Report once that a plant has fallen silent."""
        if text := self._plant.miss(now):
            self.say(text, now, "bad")

    def _take_result(self, result: m.TickResult, now: float) -> None:
        seen, tick = self._seen, f"tick {result.seq}:"
        if result.mode != (seen.mode or "solver"):
            weight: Weight = "good" if result.mode == "solver" else "bad"
            self.say(f"{tick} the command comes from {result.mode} ({result.status})", now, weight)
        seen.mode = result.mode
        seen.fallback += result.mode != "solver"
        soft = result.slack > SOFT
        seen.slack = result.slack if soft else 0.0
        seen.slack_row = result.slack_row
        seen.soft += soft
        self._take_margin(result, now)
        self._take_faults(result, now)
        seen.reference, seen.target_status = result.reference, result.target_status
        taken = result.reference_verdict == "taken"
        again = taken and result.reference_from == self._asked_by
        if result.reference_verdict != "none" and not again:
            self.say(f"{tick} reference {result.reference_verdict}", now, "good" if taken else "bad")
        self._asked_by = result.reference_from or self._asked_by
        if result.weight:
            self._take_weight(max(result.weight + result.constant_weight), tick, now)
        seen.noise = result.noise_of(self.plant.states)
        seen.weights_version = result.hidden_version
        if result.weights_rolled_back:
            seen.rolled_back += 1
            self.say(f"{tick} hidden weights {result.weights_rolled_back}", now, "bad")
        if result.weights_outcome == "adopted":
            seen.adopted += 1
            self.say(f"{tick} hidden weights {result.hidden_version} adopted", now, "good")
        elif result.weights_outcome == "refused":
            seen.refused += 1
            self.say(f"{tick} hidden weights {result.weights_verdict}", now, "bad")
        if result.prediction_error is not None:
            self._errors.append((now, result.prediction_error))
            self._follow_trend(now)

    def _take_faults(self, result: m.TickResult, now: float) -> None:
        before, began = self._seen.sensor_faults, self.first_command
        since = 0.0 if began is None else now - began
        told = {name: m.words_of_fault(name, fault, since) for name, fault in result.sensor_faults.items()}
        for name in told.keys() - before.keys():
            self.say(f"tick {result.seq}: {told[name]}", now, "bad")
        for name in before.keys() - told.keys():
            self.say(f"tick {result.seq}: sensor {name} is trusted again", now, "good")
        self._seen.sensor_faults = {name: before.get(name, text) for name, text in told.items()}

    def _take_weight(self, weight: float, tick: str, now: float) -> None:
        seen = self._seen
        seen.counts = weight
        if weight >= ADDS or self._counted is None:
            self._counted = now
        nothing = now - self._counted > self._patience
        if nothing != seen.adds_nothing:
            seen.adds_nothing = nothing
            self.say(f"{tick} {ADDS_NOTHING if nothing else 'learning has an effect again'}", now)

    def _take_margin(self, result: m.TickResult, now: float) -> None:
        margin = result.set_margin
        self._seen.set_margin, self._seen.set_piece = margin, result.set_piece
        if margin is None:
            return
        if margin < 0.0:
            self._seen.outside += 1
            self._outside_now += 1
            if self._outside_now == 1:
                text = f"OUTSIDE the certified sets by {-margin:.2g}: nothing is guaranteed"
                self.say(f"tick {result.seq}: {text}", now, "bad")
        elif self._outside_now:
            ticks = "tick" if self._outside_now == 1 else "ticks"
            text = f"back in the certified sets after {self._outside_now} {ticks}"
            self._outside_now = 0
            self.say(f"tick {result.seq}: {text}", now, "good")

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
        self._health[health.process] = health, now
        self._ended.discard(health.process)
        for name, count in health.counters.items():
            if name.startswith(m.BAD):
                if (health.process, name) not in self._bad_elsewhere:
                    self.say(f"{health.process}: {name.replace('_', ' ')}; ignored", now, "bad")
                self._bad_elsewhere[health.process, name] = count

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
        """The status in the newest Health of a process; None if there is none."""
        return self._health[process][0].status if process in self._health else None

    def forget(self, process: str) -> None:
        """A new incarnation was started: the old one's messages no longer count."""
        self._health.pop(process, None)
        self._ended.discard(process)

    def snapshot(self, now: float) -> Snapshot:
        """The content of the display at `now`, seconds on the monotonic clock."""
        plant, silent = self.plant, self._plant.silent(now)
        x, u = (None, None) if silent else (self._x, self._u)
        recent = [error for at, error in self._errors if at > now - 1.0]
        return replace(
            self._seen,
            phase=self.phase or ("the plant" if silent else ""),
            elapsed=None if self.first_command is None else now - self.first_command,
            states=_gauges(plant.states, x, plant.x_min, plant.x_max, self._goal(), plant.x_scale),
            inputs=_gauges(plant.inputs, u, plant.u_min, plant.u_max, plant.u_e, plant.u_scale),
            measured_rate=_rate(self._tick_times, now),
            solve_ms=_percentiles(self._solve_ms),
            tick_ms=_percentiles(self._tick_ms),
            prediction_error=float(np.mean(recent)) if recent else None,
            trend=tuple(self._trend),
            processes=tuple(self._row(name, now) for name in topics.PROCESSES),
            bad_messages=self.bad.total + sum(self._bad_elsewhere.values()),
            events=tuple(self._events),
        )

    def _goal(self) -> np.ndarray:
        """The target of the states, (d,)."""
        known = self.plant.states
        return with_outputs(
            self.plant, {name: r for name, r in self._seen.reference.items() if name in known}
        )

    def _row(self, name: str, now: float) -> ProcessRow:
        health, at = self._health.get(name, (None, now))
        note, counters = ("", {}) if health is None else (health.note, health.counters)
        if name in self._ended:
            return ProcessRow(name, "ended", note, counters)
        if health is not None and now - at <= SILENT_S:
            return ProcessRow(name, health.status, note, counters)
        if name == "plant" and not self._plant.silent(now):
            return ProcessRow(name, "running", "publishes only states", {})
        known = health is not None or (name == "plant" and self._plant.known)
        if name == "trainer" and not known and not self.config.trainer.enabled:
            return ProcessRow(name, "not configured", note, counters)
        return ProcessRow(name, "silent" if known else "no message", note, counters)


def _gauges(
    names: tuple[str, ...],
    values: Sequence[float | None] | None,
    low: np.ndarray,
    high: np.ndarray,
    target: np.ndarray,
    scale: np.ndarray,
) -> tuple[Gauge, ...]:
    rows = zip(names, values or [None] * len(names), low, high, target, scale, strict=True)
    return tuple(Gauge(*row) for row in rows)


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
