"""The monitor of a run: counts, events, and silent processes."""

from __future__ import annotations

import msgspec
import pytest

from node_runtime.bus.mailbox import Delivery
from node_runtime.config.loading import override
from protocol import topics
from tandem.live.monitor import Monitor, Snapshot
from tests.tandem.live.heard import CONFIG, PLANT, START, command, delivery, health, result, state, tick


def test_counts_results_by_kind(monitor: Monitor):
    now = monitor.snapshot(START + 2.5)
    assert (now.ticks, now.late, now.skipped, now.fallback, now.soft) == (50, 1, 2, 1, 1)
    assert (now.adopted, now.refused, now.weights_version) == (1, 1, 3)
    assert now.elapsed == pytest.approx(2.5)
    assert monitor.slots == 50
    assert now.measured_rate == pytest.approx(20.0)
    assert now.solve_ms == pytest.approx((2.45, 4.851))
    assert [g.value for g in now.states] == [0.3, 1.5, 1.1, 0.2]
    assert len(now.trend) == 2
    assert now.trend[0] > now.trend[1]
    assert now.bad_messages == 2
    texts = " ".join(event.text for event in now.events)
    for expected in ("shifted_plan", "adopted", "refused: not finite"):
        assert expected in texts


def test_a_process_without_messages_is_shown_as_silent(monitor: Monitor):
    monitor.ended("trainer")
    monitor.forget("plant")
    rows = {row.name: row.status for row in monitor.snapshot(START + 10.0).processes}
    assert rows == {
        "router": "silent",
        "plant": "silent",
        "controller": "silent",
        "trainer": "ended",
        "recorder": "silent",
    }


@pytest.mark.parametrize(
    "bad",
    [
        Delivery(topics.PLANT_STATE.key(CONFIG.name), b"\xff", 0),
        Delivery("tandem/jet1/not/known", b"", 0),
        delivery(topics.PLANT_STATE, state(60, float("nan")), START + 2.5),
        delivery(topics.PLANT_STATE, state(3), START + 2.5),
    ],
    ids=["malformed", "unknown topic", "not finite", "out of order"],
)
def test_bad_messages_are_counted_and_not_shown(monitor: Monitor, bad: Delivery):
    before = monitor.snapshot(START + 2.5)
    monitor.feed(bad)
    after = monitor.snapshot(START + 2.5)
    assert after.states == before.states
    assert after.bad_messages == before.bad_messages + 1


def test_a_users_own_topic_is_no_bad_message(monitor: Monitor) -> None:
    before = monitor.snapshot(START + 2.5).bad_messages
    monitor.feed(Delivery("tandem/jet1/user/weather/wind", b"\xff", 0))
    assert monitor.snapshot(START + 2.5).bad_messages == before
    monitor.feed(Delivery("tandem/jet2/user/weather/wind", b"\xff", 0))
    assert monitor.snapshot(START + 2.5).bad_messages == before + 1


def test_every_simultaneous_tick_counts_and_only_the_newest_state_is_read() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed_all([delivery(topics.COMMAND, command(0), START)])
    assert seen.first_command == pytest.approx(START)
    batch = []
    for k in range(1, 20):
        at = START + 0.001 * k
        batch += [
            delivery(topics.PLANT_STATE, state(k, z=0.01 * k), at),
            delivery(topics.COMMAND, command(k), at),
            delivery(topics.TICK, tick(k, late=k == 7), at),
            delivery(topics.RESULT, result(k, verdict="adopted" if k == 5 else "none"), at),
            delivery(topics.OUTPUT_WEIGHTS, command(k), at),
        ]
    seen.feed_all(batch)
    now = seen.snapshot(START + 0.1)
    assert (now.ticks, now.late, now.adopted) == (19, 1, 1)
    assert now.states[0].value == pytest.approx(0.19)
    assert seen.bad.total == 0


def test_the_first_command_of_several_messages_is_found() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed_all([delivery(topics.COMMAND, command(k), START + 0.001 * k) for k in range(5)])
    assert seen.first_command == pytest.approx(START)


def plant_row(now: Snapshot) -> tuple[str, str]:
    (row,) = (row for row in now.processes if row.name == "plant")
    return row.status, row.note


def test_a_plant_that_publishes_only_states_counts_as_running() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    assert plant_row(seen.snapshot(START)) == ("no message", "")
    seen.feed(delivery(topics.PLANT_STATE, state(0), START))
    assert plant_row(seen.snapshot(START + 1.0)) == ("running", "publishes only states")
    assert plant_row(seen.snapshot(START + 3.0)) == ("silent", "")
    # A plant that sends health may be followed by one that does not.
    seen.feed(delivery(topics.HEALTH["plant"], health("plant", {}, "as usual"), START + 3.0))
    assert plant_row(seen.snapshot(START + 3.0)) == ("running", "as usual")
    assert plant_row(seen.snapshot(START + 6.0)) == ("silent", "as usual")
    seen.feed(delivery(topics.PLANT_STATE, state(99), START + 6.0))
    assert plant_row(seen.snapshot(START + 6.0)) == ("running", "publishes only states")


def test_a_slow_plant_is_not_silent_between_two_samples() -> None:
    seen = Monitor(override(CONFIG, ["rate=0.2"]), PLANT, 100.0)
    seen.feed(delivery(topics.PLANT_STATE, state(0), START))
    seen.miss_plant(START + 10.0)
    assert seen.snapshot(START + 10.0).phase == ""
    seen.miss_plant(START + 15.1)
    assert seen.new_events()


def test_a_bad_message_is_reported_once() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    fields = {"run_id": "p", "seq": 0, "t": 0.0, "x": [0.0] * 4, "applied": None, "command_seq": -1}
    for _ in range(3):
        seen.feed(Delivery(topics.PLANT_STATE.key(CONFIG.name), msgspec.msgpack.encode(fields), 0))
    (event,) = seen.new_events()
    assert event.text == "plant/state: malformed: Object missing required field `source`; ignored"
    assert seen.bad.total == 3


def test_begin_and_end_of_manual_control_are_reported() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    for k, source in enumerate(["command", "manual", "manual", "plan"]):
        driven = msgspec.structs.replace(state(k), source=source, applied=[1.5 + k])
        seen.feed(delivery(topics.PLANT_STATE, driven, START + k))
        seen.feed(delivery(topics.COMMAND, command(k), START + k))
        now = seen.snapshot(START + k)
        # The display shows the acting input.
        assert (now.inputs[0].value == 1.5 + k) == (source == "manual")
    assert [event.text for event in now.events if "manual" in event.text] == [
        "the plant is under manual control",
        "the plant is no longer under manual control; the input comes from: plan",
    ]
