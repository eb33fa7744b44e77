"""Events of a run as messages of `foxglove.Log`, which Foxglove and Lichtblick show as a log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import msgspec

from protocol import messages as m
from protocol import topics
from run_log.views.channel import Channel, Json, Shown, leaf

BURST = 10
"""Number of events of one kind that are shown at once. Then one is shown every `APART_NS`, with the omitted number."""
APART_NS = 500_000_000
MOST_SENDERS = 100
TARGETS = {
    "none": "the plan aims at the equilibrium",
    "reached": "the plan aims at the set-point",
    "nearest": "the set-point is out of reach, and the plan aims at the nearest steady state",
    "no rest": "no steady state was found inside X and U",
}
"""Status of the target, in words."""


class Level(IntEnum):
    """Levels of `foxglove.LogLevel`."""

    UNKNOWN = 0
    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


def _log_schema() -> Json:
    """The well-known schema `foxglove.Log`, with every field required."""
    time = {
        "type": "object",
        "title": "time",
        "properties": {
            "sec": {"type": "integer", "minimum": 0},
            "nsec": {"type": "integer", "minimum": 0, "maximum": 999_999_999},
        },
        "required": ["sec", "nsec"],
        "additionalProperties": False,
        "description": "Timestamp of log message",
    }
    levels = [{"title": level.name, "const": level.value} for level in Level]
    fields = {
        "timestamp": time,
        "level": {"title": "foxglove.LogLevel", "description": "Log level", "oneOf": levels},
        "message": leaf("string", "Log message"),
        "name": leaf("string", "Process or node name"),
        "file": leaf("string", "Filename"),
        "line": leaf("integer", "Line number in the file") | {"minimum": 0},
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "foxglove.Log",
        "description": "A log message",
        "type": "object",
        "properties": fields,
        "required": list(fields),
        "additionalProperties": False,
    }


@dataclass
class _Kind:
    """Recent events of one kind."""

    left: float = BURST
    at: int = 0
    withheld: int = 0
    newest: tuple[Level, str, str] | None = None
    """The last withheld event."""


def _calm_result(result: Any) -> tuple[object, ...] | None:
    """Return all fields of a result that could give an event; None if it has one for certain. Runs at every tick."""
    if result.weights_verdict != "none" or result.reference_verdict != "none" or result.weights_rolled_back:
        return None
    outside = result.set_margin is not None and result.set_margin < 0.0
    return result.mode, result.status, result.sensor_faults, result.target_status, outside


class Events:
    """Follows the messages of a run and reports changes."""

    def __init__(self) -> None:
        self.channel = Channel("events", _log_schema(), "foxglove.Log")
        self._was: dict[str, Any] = {}
        """Last value, by kind."""
        self._kinds: dict[str, _Kind] = {}
        self._calm: tuple[object, ...] | None = None
        """The last result, if it had no event."""
        self._waiting = False
        self._now = 0

    def take(self, name: str, message: Any, time_ns: int) -> list[Shown]:
        """Return the events of a message of topic `name`, or of its head (`run_log.views.heads`)."""
        self._now = time_ns
        shown = self._overdue() if self._waiting else []
        found: Iterator[Shown | None] | None = None
        if name == topics.RESULT.name:
            calm = _calm_result(message)
            if calm is not None and calm == self._calm:
                return shown
            self._calm = calm
            found = self._of_result(message)
        elif name == topics.TICK.name:
            usual = message.state_verdict == self._was.get("state", "fresh")
            if usual and not (message.late or message.skipped or message.truth):
                return shown
            found = self._of_tick(message)
        elif name == topics.PLANT_STATE.name:
            if message.source == self._was.get("source"):
                return shown
            found = self._of_state(message)
        elif isinstance(message, m.Health):
            found = self._of_health(message)
        elif isinstance(message, m.RunInfo):
            found = self._of_run_info(message)
        elif name == topics.KEYFRAME.name:
            found = self._of_keyframe(message)
        return [*shown, *(one for one in found if one is not None)] if found is not None else shown

    def lost(self, name: str, seq: int, missing: int, time_ns: int) -> list[Shown]:
        """Return the event for messages of topic `name` that are lost just before number `seq`."""
        self._now = time_ns
        what = (
            f"message {seq - 1} is missing"
            if missing == 1
            else f"messages {seq - missing} to {seq - 1} are missing"
        )
        event = self._say("lost", Level.WARNING, "recorder", f"{name}: {what}")
        return [] if event is None else [event]

    def _of_state(self, state: Any) -> Iterator[Shown | None]:
        before = self._change("source", state.source)
        if before is not None:
            level = Level.INFO if state.source in ("command", "hold", "manual") else Level.WARNING
            yield self._say(
                "source", level, "plant", f"the input comes from: {state.source} (before: {before})"
            )

    def _of_tick(self, tick: Any) -> Iterator[Shown | None]:
        who = f"tick {tick.seq}"
        if tick.late:
            yield self._say(
                "late", Level.WARNING, "controller", f"{who} started {tick.lateness * 1e3:.1f} ms late"
            )
        if tick.skipped:
            slots = "1 slot was" if tick.skipped == 1 else f"{tick.skipped} slots were"
            yield self._say("skipped", Level.WARNING, "controller", f"{slots} skipped before {who}")
        if self._change("state", tick.state_verdict, "fresh") is not None:
            level = Level.INFO if tick.state_verdict == "fresh" else Level.WARNING
            yield self._say("state", level, "controller", f"{who}: the sample is {tick.state_verdict}")
        if tick.truth:
            new = ", ".join(f"{name} = {value:g}" for name, value in tick.truth.items())
            yield self._say(
                "truth", Level.INFO, "controller", f"{who}: the true plant has {new} from here on"
            )

    def _of_result(self, result: Any) -> Iterator[Shown | None]:
        who = f"tick {result.seq}"
        mode, verdict = result.mode, result.weights_verdict
        if self._change("mode", mode, "solver") is not None:
            level = Level.INFO if mode == "solver" else Level.WARNING
            yield self._say(
                "mode", level, "controller", f"{who}: the command comes from {mode} ({result.status})"
            )
        elif (before := self._change("status", result.status)) is not None:
            yield self._say(
                "status", Level.DEBUG, "controller", f"{who}: solver: {result.status} (before: {before})"
            )
        if verdict != "none":
            adopted = verdict == "adopted"
            text = f"version {result.hidden_version} adopted" if adopted else verdict
            level = Level.INFO if adopted else Level.WARNING
            yield self._say("weights", level, "controller", f"{who}: hidden weights {text}")
        if result.weights_rolled_back:
            text = f"{who}: hidden weights rolled back: {result.weights_rolled_back}"
            yield self._say("rolled back", Level.WARNING, "controller", text)
        yield from self._faults(result, who)
        # A renewed lease does not make a new reference.
        renewed = result.reference_verdict == "taken" and result.reference_from == self._was.get("asked by")
        if result.reference_verdict != "none" and not renewed:
            level = Level.INFO if result.reference_verdict == "taken" else Level.WARNING
            now = ", ".join(f"{name} {value:.6g}" for name, value in result.reference.items())
            text = f"{who}: reference {result.reference_verdict}{f'; now {now}' if now else ''}"
            yield self._say("reference", level, "controller", text)
        if result.reference_from:
            self._was["asked by"] = result.reference_from
        if self._change("target", result.target_status, "none") is not None:
            level = Level.WARNING if result.target_status == "no rest" else Level.INFO
            yield self._say("target", level, "controller", f"{who}: {TARGETS[result.target_status]}")
        if result.set_margin is not None:
            outside = result.set_margin < 0.0
            if self._change("outside", outside, False) is not None:
                level = Level.ERROR if outside else Level.INFO
                text = "outside the certified sets" if outside else "inside the certified sets again"
                yield self._say("outside", level, "controller", f"{who}: {text}")

    def _faults(self, result: Any, who: str) -> Iterator[Shown | None]:
        now, before = result.sensor_faults, self._was.get("faults", {})
        if now.keys() == before.keys():
            return
        self._was["faults"] = now
        for name in now.keys() - before.keys():
            yield self._say("fault", Level.ERROR, "controller", f"{who}: sensor {name} is {now[name]}")
        for name in before.keys() - now.keys():
            yield self._say("fault", Level.INFO, "controller", f"{who}: sensor {name} is trusted again")

    def _of_health(self, health: m.Health) -> Iterator[Shown | None]:
        who = health.process
        if self._change(f"status of {who}", (health.run_id, health.status), ()) is not None:
            level = Level.ERROR if health.status == "failed" else Level.INFO
            yield self._say(
                "process", level, who, f"{health.status}: {health.note}" if health.note else health.status
            )
        for name, count in health.counters.items():
            if name.startswith(m.BAD) and count and self._change(f"{who} {name}", True, False) is not None:
                yield self._say("bad", Level.WARNING, who, f"messages were ignored: {name}")

    def _of_run_info(self, info: m.RunInfo) -> Iterator[Shown | None]:
        if self._change(f"run of {info.process}", info.run_id, "") is not None:
            yield self._say("run", Level.INFO, info.process, f"run {info.run_id}")

    def _of_keyframe(self, keyframe: Any) -> Iterator[Shown | None]:
        if keyframe.resumed:
            yield self._say(
                "resumed", Level.INFO, "controller", f"continues from the memory of run {keyframe.resumed}"
            )

    def _change(self, kind: str, now: Any, usual: Any = None) -> Any:
        """Return the previous value if it differs; None if it has not changed.

        usual: the value before the first message; None: there was none.
        """
        before = self._was.get(kind, usual)
        if before == now:
            return None
        if kind not in self._was and len(self._was) >= 10 * MOST_SENDERS:
            return None
        self._was[kind] = now
        return before

    def _say(self, kind: str, level: Level, name: str, text: str) -> Shown | None:
        counted = self._kinds.setdefault(kind, _Kind(at=self._now))
        counted.left = min(BURST, counted.left + (self._now - counted.at) / APART_NS)
        counted.at = self._now
        if counted.left < 1.0:
            counted.withheld += counted.newest is not None
            counted.newest = (level, name, text)
            self._waiting = True
            return None
        more = counted.withheld + (counted.newest is not None)
        counted.left, counted.withheld, counted.newest = counted.left - 1.0, 0, None
        return self._event(
            level, name, f"{text} ({more} such events before it are not shown)" if more else text
        )

    def _overdue(self) -> list[Shown]:
        """Return the newest withheld event of every kind that is due again."""
        shown = []
        for kind, counted in self._kinds.items():
            if counted.newest is not None and self._now - counted.at >= APART_NS:
                newest, counted.newest = counted.newest, None
                event = self._say(kind, *newest)
                shown += [] if event is None else [event]
        self._waiting = any(counted.newest is not None for counted in self._kinds.values())
        return shown

    def _event(self, level: Level, name: str, text: str) -> Shown:
        sec, nsec = divmod(max(0, self._now), 1_000_000_000)
        stamp = {"sec": sec, "nsec": nsec}
        event = {
            "timestamp": stamp,
            "level": int(level),
            "message": text,
            "name": name,
            "file": "",
            "line": 0,
        }
        return Shown(self.channel, msgspec.json.encode(event))
