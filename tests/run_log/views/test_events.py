"""Each change gives one event, a message of `foxglove.Log`. The rate of events is limited."""

from __future__ import annotations

import json
import math
from typing import Any

import jsonschema
import msgspec
import pytest

from lbmpc.plants import get_plant
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from run_log.views.events import BURST, Level
from run_log.views.views import Views
from tests.run_log.samples import synthetic

MS = 1_000_000
CONFIG, LOGGED = synthetic(steps=2)
RESULT = next(message for topic, message, _ in LOGGED if topic is topics.RESULT)
TICK = next(message for topic, message, _ in LOGGED if topic is topics.TICK)
STATE = next(message for topic, message, _ in LOGGED if topic is topics.PLANT_STATE)
HEALTH = m.Health(run_id="p-1", seq=0, process="plant", status="running", counters={}, note="")


class Told:
    """Feeds messages and keeps the events."""

    def __init__(self) -> None:
        self.views = Views(Config(), get_plant("moore_greitzer"))
        self.seq = -1
        self.now = 0

    def by(
        self, topic: Topic, message: m.Message, after_ms: float = 50.0, **changes: Any
    ) -> list[dict[str, Any]]:
        self.seq, self.now = self.seq + 1, self.now + round(after_ms * MS)
        payload = codec.encode(msgspec.structs.replace(message, seq=self.seq, **changes))
        seen = self.views.show(topic.name, payload, self.now)
        events = [shown for shown in seen.shown if shown.channel.topic == "view/events"]
        for event in events:
            assert event.channel.schema_name == "foxglove.Log"
            jsonschema.validate(json.loads(event.data), event.channel.schema)
        return [json.loads(event.data) for event in events]


def test_a_status_that_follows_at_once_is_told_however_few_views_are_made() -> None:
    views = Views(Config(), get_plant("moore_greitzer"), most_hz=100.0)
    for seq, status in enumerate(("starting", "ready", "running")):
        payload = codec.encode(msgspec.structs.replace(HEALTH, seq=seq, status=status))
        shown = views.show("plant/health", payload, seq * MS).shown
        assert [one.channel.topic for one in shown] == ["view/events", "view/plant/health"]
        assert json.loads(shown[1].data)["status"] == status


def test_a_reference_between_two_views_is_reported() -> None:
    views = Views(Config(), get_plant("moore_greitzer"), most_hz=1.0)
    views.show("controller/result", codec.encode(RESULT), 0)
    taken = msgspec.structs.replace(
        RESULT,
        seq=RESULT.seq + 1,
        reference={"y": 1.8},
        reference_verdict="taken",
        reference_from="commander-1",
    )
    (shown,) = views.show("controller/result", codec.encode(taken), MS).shown
    assert json.loads(shown.data)["message"] == f"tick {taken.seq}: reference taken; now y 1.8"


def test_each_change_of_a_result_is_reported_once_with_its_level() -> None:
    told = Told()
    assert told.by(topics.RESULT, RESULT) == []
    for changes, level, words in [
        ({"mode": "shifted_plan", "status": "infeasible"}, Level.WARNING, "comes from shifted_plan (infeasible)"),
        ({"mode": "solver"}, Level.INFO, "comes from solver"),
        ({"status": "iteration limit"}, Level.DEBUG, "solver: iteration limit"),
        ({"weights_verdict": "adopted", "hidden_version": 7}, Level.INFO, "version 7 adopted"),
        ({"weights_verdict": "refused: sha256"}, Level.WARNING, "refused: sha256"),
        ({"weights_rolled_back": "worse than before"}, Level.WARNING, "rolled back: worse than before"),
        ({"sensor_faults": {"y": "stuck; estimated"}}, Level.ERROR, "sensor y is stuck"),
        ({}, Level.INFO, "sensor y is trusted again"),
        (
            {"reference_verdict": "taken", "reference_from": "h-1", "reference": {"y": 1.7}},
            Level.INFO,
            "reference taken; now y 1.7",
        ),
        ({"reference_verdict": "refused: outside X", "reference_from": "h-1"}, Level.WARNING, "outside X"),
        ({"set_margin": -0.1}, Level.ERROR, "outside the certified sets"),
        ({"set_margin": 0.1}, Level.INFO, "inside the certified sets again"),
        ({"target_status": "no rest"}, Level.WARNING, "no steady state was found"),
        ({}, Level.INFO, "the plan aims at the equilibrium"),
    ]:  # fmt: skip
        (event,) = (
            one for one in told.by(topics.RESULT, RESULT, 600.0, **changes) if words in one["message"]
        )
        assert (event["level"], event["name"]) == (level, "controller")
        assert event["timestamp"] == dict(zip(("sec", "nsec"), divmod(told.now, 10**9), strict=True))
        if not any(key.startswith(("weights", "reference")) for key in changes):
            again = told.by(topics.RESULT, RESULT, **{"status": RESULT.status, **changes})
            assert not [one for one in again if words in one["message"]]


def test_a_lease_that_is_renewed_is_no_event() -> None:
    told = Told()
    asked = {"reference_verdict": "taken", "reference_from": "h-1"}
    assert len(told.by(topics.RESULT, RESULT, **asked)) == 1
    assert told.by(topics.RESULT, RESULT, **asked) == []
    assert len(told.by(topics.RESULT, RESULT, **{**asked, "reference_from": "h-2"})) == 1


def test_late_ticks_skipped_slots_and_samples_that_do_not_come() -> None:
    told = Told()
    assert told.by(topics.TICK, TICK) == []
    (late,) = told.by(topics.TICK, TICK, late=True, lateness=0.0123)
    assert late["message"] == "tick 1 started 12.3 ms late"
    (skipped,) = told.by(topics.TICK, TICK, skipped=3)
    assert skipped["message"] == "3 slots were skipped before tick 2"
    (missing,) = told.by(topics.TICK, TICK, state_verdict="missing", state=None)
    assert (missing["level"], missing["message"]) == (Level.WARNING, "tick 3: the sample is missing")
    assert [one["level"] for one in told.by(topics.TICK, TICK)] == [Level.INFO]


def test_changes_of_the_input_source_and_of_processes_are_events() -> None:
    told = Told()
    assert told.by(topics.PLANT_STATE, STATE) == []
    assert [one["level"] for one in told.by(topics.PLANT_STATE, STATE, source="safe")] == [Level.WARNING]
    (back,) = told.by(topics.PLANT_STATE, STATE, source="command")
    assert (back["level"], back["message"]) == (Level.INFO, "the input comes from: command (before: safe)")
    health = topics.HEALTH["plant"]
    assert [one["message"] for one in told.by(health, HEALTH)] == ["running"]
    assert told.by(health, HEALTH) == []
    bad = {"bad_controller_command_foreign": 2, "samples": 3}
    (rejected,) = told.by(health, HEALTH, counters=bad)
    assert rejected["message"] == "messages were ignored: bad_controller_command_foreign"
    assert told.by(health, HEALTH, counters=bad) == []
    assert [one["level"] for one in told.by(health, HEALTH, status="failed")] == [Level.ERROR]


def test_lost_ticks_are_an_event() -> None:
    told = Told()
    told.by(topics.TICK, TICK)
    told.seq += 4
    (gap,) = told.by(topics.TICK, TICK)
    assert gap["message"] == "controller/tick: messages 1 to 4 are missing"
    assert told.views.lost == {"controller/tick": 4}


def test_a_flood_of_events_is_limited_and_its_last_event_is_shown() -> None:
    told = Told()
    events = [
        one for k in range(1000) for one in told.by(topics.TICK, TICK, 1.0, late=True, lateness=k * 1e-3)
    ]
    assert BURST <= len(events) <= BURST + 3
    assert "such events before it are not shown" in events[-1]["message"]
    (last,) = told.by(topics.TICK, TICK, 600.0)
    assert "tick 999 started 999.0 ms late" in last["message"]
    assert told.by(topics.TICK, TICK, 600.0) == []


@pytest.mark.parametrize("rate", [50, 1000])
def test_no_event_is_missed_where_a_fast_loop_has_fewer_views(rate: int) -> None:
    told = Told()
    events = []
    for k in range(rate):
        events += told.by(topics.TICK, TICK, 1e3 / rate, late=k % (rate // 5) == 3, lateness=0.001)
    assert len(events) == 5


def test_at_full_rate_messages_out_of_order_have_views_too() -> None:
    views = Views(Config(), get_plant("moore_greitzer"), most_hz=math.inf)
    sent = {"plant/state": codec.encode(STATE), "plant/health": codec.encode(HEALTH), "user/wind": b"1"}
    for name, payload in sent.items():
        for time_ns in (9 * MS, 7 * MS):
            shown = views.show(name, payload, time_ns).shown
            assert f"view/{name}" in [one.channel.topic for one in shown]
