"""What the live view makes of messages, and that it fits every terminal."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import msgspec
import pytest
from rich.console import Console

from lbmpc.plants import get_plant
from node_runtime.bus.mailbox import Delivery
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import codec, topics
from protocol import messages as m
from protocol.topics import Topic
from tandem.live import view
from tandem.live.monitor import Monitor
from tandem.live.snapshot import Snapshot
from tests.helpers.plants.integrator import INTEGRATOR

CONFIG = Config()
PLANT = get_plant(CONFIG.plant.model)
START = 100.0


def delivery(topic: Topic, message: m.Message, at: float) -> Delivery:
    return Delivery(topic.key(CONFIG.name), codec.encode(message), round(at * 1e9))


def state(seq: int, z: float = 0.3) -> m.PlantState:
    return m.PlantState(
        run_id="p",
        seq=seq,
        t=seq * 0.05,
        x=[z, 1.5, 1.1, 0.2],
        applied=[1.0],
        source="command",
        command_seq=seq,
    )


def command(seq: int) -> m.Command:
    return m.Command(
        run_id="c",
        seq=seq,
        state_run_id="p",
        state_seq=seq,
        period=0.05,
        mode="solver",
        u=[1.0],
        plan=[[1.0]],
    )


def tick(seq: int, late: bool = False, skipped: int = 0) -> m.Tick:
    return m.Tick(
        run_id="c",
        seq=seq,
        slot=seq,
        t=seq * 0.05,
        skipped=skipped,
        lateness=0.0,
        late=late,
        state_verdict="fresh",
        state=None,
        weights=None,
    )


def result(
    seq: int,
    *,
    mode: m.CommandMode = "solver",
    verdict: str = "none",
    error: float = 1e-3,
    slack: float = 0.0,
) -> m.TickResult:
    return m.TickResult(
        run_id="c",
        seq=seq,
        x=[0.3, 1.5, 1.1, 0.2],
        u=[1.0],
        mode=mode,
        status="converged",
        iterations=2,
        slack=slack,
        slack_row="y at step 3" if slack else "",
        h=None,
        h_hat=None,
        prediction_error=error,
        oracle_norms=[],
        hidden_version=3,
        hidden_sha256="",
        tick_crc32=0,
        input_delay=0.0,
        weights_verdict=verdict,
    )


def test_a_sensor_that_is_not_believed_is_said_once_and_shown(monitor: Monitor) -> None:
    stuck = {"y": "stuck; what it measures is estimated from the others"}
    for k, faults in ((50, stuck), (51, stuck), (52, {})):
        answer = msgspec.structs.replace(result(k), sensor_faults=faults)
        monitor.feed(delivery(topics.RESULT, answer, START + 0.05 * k))
        if k == 51:
            assert "sensor y is stuck since 2.5 s; what it measures is estimated" in view.line(
                monitor.snapshot(START + 2.6)
            )
            console = Console(file=io.StringIO(), width=120, height=40)
            console.print(view.render(monitor.snapshot(START + 2.6), 120, 40))
            assert "not believed" in console.file.getvalue()  # type: ignore[attr-defined]
    said = [event.text for event in monitor.snapshot(START + 2.7).events if "sensor" in event.text]
    assert said == [
        "tick 50: sensor y is stuck since 2.5 s; what it measures is estimated from the others",
        "tick 52: sensor y is believed again",
    ]


def health(process: str, counters: dict[str, int], note: str = "") -> m.Health:
    return m.Health(run_id=process, seq=0, process=process, status="running", counters=counters, note=note)


@pytest.fixture
def monitor() -> Monitor:
    """Two and a half seconds of a run in which everything happened once."""
    seen = Monitor(CONFIG, PLANT, 20.0)
    for process in topics.PROCESSES:
        counters = (
            {"samples": 3, "bad plant/state: not finite": 2} if process == "controller" else {"samples": 3}
        )
        seen.feed(delivery(topics.HEALTH[process], health(process, counters, "a note " * 30), START - 1.0))
    for k in range(50):
        at = START + 0.05 * k
        seen.feed(delivery(topics.PLANT_STATE, state(k), at))
        seen.feed(delivery(topics.COMMAND, command(k), at))
        seen.feed(delivery(topics.TICK, tick(k, late=k == 7, skipped=2 * (k == 9)), at))
        mode: m.CommandMode = "shifted_plan" if k == 20 else "solver"
        verdict = {30: "adopted", 35: "refused: not finite"}.get(k, "none")
        slack = 1e-3 if k == 3 else 0.0
        answer = result(k, mode=mode, verdict=verdict, error=10.0 ** -(2 + k / 10), slack=slack)
        seen.feed(delivery(topics.RESULT, answer, at))
        timing = m.TickTiming(
            run_id="c", seq=k, solve_ms=k / 10, tick_ms=k / 5, lateness_ms=0.0, state_age_ms=0.0
        )
        seen.feed(delivery(topics.TIMING, timing, at))
    return seen


def drawn(now: Snapshot, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(view.render(now, width, height))
    return capture.get().splitlines()


def test_counts_what_happened(monitor: Monitor):
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


def test_a_process_that_says_nothing_any_more_is_silent(monitor: Monitor):
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
        Delivery("tandem/jet1/nobody/knows", b"", 0),
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


@pytest.mark.parametrize(("width", "height"), [(100, 30), (80, 24), (60, 24), (60, 50), (40, 20), (200, 60)])
def test_fits(monitor: Monitor, width: int, height: int):
    for now in (monitor.snapshot(START + 2.5), Monitor(CONFIG, PLANT, 20.0).snapshot(START)):
        lines = drawn(now, width, height)
        assert max(map(len, lines)) <= width
        assert len(lines) <= height


def test_shows_what_matters(monitor: Monitor):
    text = "\n".join(drawn(monitor.snapshot(START + 2.5), 100, 30))
    for expected in (
        "0.3000",
        "20.00 Hz",
        "1 late",
        "2 skipped",
        "1 fallback",
        "1 soft ticks",
        "1 adopted",
        "bad plant/state: not finite 2",
        "2.5 / 20 s",
        "●",
    ):
        assert expected in text


@pytest.mark.parametrize(("z", "mark"), [(-0.4, "◀"), (1.7, "▶"), (0.5, "●")])
def test_a_value_outside_its_bounds_is_marked(z: float, mark: str):
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed(delivery(topics.PLANT_STATE, state(0, z), START))
    assert mark in "\n".join(drawn(seen.snapshot(START), 100, 30))


def test_it_is_said_when_learning_adds_nothing_for_seconds_and_when_it_counts_again() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed(delivery(topics.COMMAND, command(0), START))

    def after(k: int, weight: float, constant: float = 0.0) -> tuple[str, str, str]:
        of_a_state = msgspec.structs.replace(
            result(k), weight=[0.0, weight, 0.0, 0.0], constant_weight=[0.0, 0.0, constant, 0.0]
        )
        at = START + 0.05 * k
        seen.feed(delivery(topics.RESULT, of_a_state, at))
        now = seen.snapshot(at)
        return (
            "\n".join(drawn(now, 100, 30)),
            view.line(now),
            " ".join(event.text for event in seen.new_events()),
        )

    assert "counts 80%" in after(0, 0.8)[0]
    for k in range(1, 60):
        panel, line, _events = after(k, 0.05)
        assert "counts 5%" in panel
        assert "learning adds nothing" not in line
    panel, line, events = after(61, 0.05)
    assert "adds nothing" in panel
    for text in (line, events):
        assert "learning adds nothing: noise exceeds h" in text
    assert "learning" not in after(62, 0.02)[2]
    panel, line, events = after(63, 0.0, 0.3)
    assert "counts 30%" in panel
    assert "nothing" not in line
    assert "learning counts again" in events


def test_noise_that_was_found_is_shown_of_the_states_that_are_measured() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed(delivery(topics.COMMAND, command(0), START))
    seen.feed(delivery(topics.RESULT, result(0), START))
    assert "noise" not in view.line(seen.snapshot(START))
    seen.feed(
        delivery(topics.RESULT, msgspec.structs.replace(result(1), noise=[0.0051, 0.02, 0.0, 0.0]), START)
    )
    now = seen.snapshot(START)
    assert "noise z 0.0051 y 0.02 |" in view.line(now)
    assert "noise found z 0.0051 y 0.02" in " ".join("".join(drawn(now, 100, 30)).split())


def test_one_line(monitor: Monitor):
    text = view.line(monitor.snapshot(START + 2.5))
    assert "\n" not in text
    for expected in ("z 0.3000", "50 ticks, 1 late", "1 adopted, 1 refused"):
        assert expected in text
    seen = Monitor(CONFIG, PLANT, 20.0)
    assert view.line(seen.snapshot(START)).startswith("waiting for the plant: ")
    seen.feed(delivery(topics.PLANT_STATE, state(0), START))
    assert view.line(seen.snapshot(START)).startswith("waiting for the first command: ")


def test_bars_fall_with_the_error():
    bars = view.spark([1e-2, 1e-3, 1e-4, 1e-5], 10).plain
    assert list(bars) == sorted(bars, reverse=True)
    assert len(view.spark([1.0] * 50, 10).plain) == 10


def test_of_what_comes_together_every_tick_counts_and_only_the_newest_state_is_read() -> None:
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


def test_the_first_command_is_not_overlooked_among_others() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed_all([delivery(topics.COMMAND, command(k), START + 0.001 * k) for k in range(5)])
    assert seen.first_command == pytest.approx(START)


def plant_row(now: Snapshot) -> tuple[str, str]:
    (row,) = (row for row in now.processes if row.name == "plant")
    return row.status, row.note


def test_a_plant_that_says_only_its_states_runs_while_they_come() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    assert plant_row(seen.snapshot(START)) == ("not heard of", "")
    seen.feed(delivery(topics.PLANT_STATE, state(0), START))
    assert plant_row(seen.snapshot(START + 1.0)) == ("running", "says only its states")
    assert plant_row(seen.snapshot(START + 3.0)) == ("silent", "")
    # One that was chatty may be followed by one that is not.
    seen.feed(delivery(topics.HEALTH["plant"], health("plant", {}, "as usual"), START + 3.0))
    assert plant_row(seen.snapshot(START + 3.0)) == ("running", "as usual")
    assert plant_row(seen.snapshot(START + 6.0)) == ("silent", "as usual")
    seen.feed(delivery(topics.PLANT_STATE, state(99), START + 6.0))
    assert plant_row(seen.snapshot(START + 6.0)) == ("running", "says only its states")


def test_a_plant_that_falls_silent_is_missed_and_its_return_is_said() -> None:
    def said() -> list[str]:
        return [event.text for event in seen.new_events()]

    seen = Monitor(CONFIG, PLANT, math.inf)
    seen.feed_all(
        [delivery(topics.COMMAND, command(0), START), delivery(topics.PLANT_STATE, state(0), START)]
    )
    said()
    seen.miss_plant(START + 1.9)
    assert said() == []
    assert seen.snapshot(START + 1.9).phase == ""
    for at in (2.1, 2.2):
        seen.miss_plant(START + at)
    assert said() == ["the plant is silent: no state for 2.1 s"]
    away = seen.snapshot(START + 2.2)
    assert away.phase == "the plant"
    assert [gauge.value for gauge in (*away.states, *away.inputs)] == [None] * 5
    assert "waiting for the plant" in drawn(away, 100, 30)[0]
    assert "waiting for the plant" in view.line(away)
    seen.feed(delivery(topics.PLANT_STATE, state(60), START + 3.0))
    assert said() == ["the plant is back after 3.0 s"]
    assert seen.snapshot(START + 3.0).states[0].value == pytest.approx(0.3)
    assert "3.0 s, until Ctrl-C" in drawn(seen.snapshot(START + 3.0), 100, 30)[0]
    again = m.PlantState(
        run_id="q", seq=0, t=0.0, x=[0.3, 1.5, 1.1, 0.2], applied=None, source="hold", command_seq=-1
    )
    seen.miss_plant(START + 7.0)
    seen.feed(delivery(topics.PLANT_STATE, again, START + 8.0))
    assert said()[-1] == "the plant was started again after 5.0 s, as q: a new episode"


def test_a_slow_plant_is_not_missed_between_two_of_its_samples() -> None:
    seen = Monitor(override(CONFIG, ["rate=0.2"]), PLANT, 100.0)
    seen.feed(delivery(topics.PLANT_STATE, state(0), START))
    seen.miss_plant(START + 10.0)
    assert seen.snapshot(START + 10.0).phase == ""
    seen.miss_plant(START + 15.1)
    assert seen.new_events()


def test_what_is_wrong_with_a_message_is_said_once() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    fields = {"run_id": "p", "seq": 0, "t": 0.0, "x": [0.0] * 4, "applied": None, "command_seq": -1}
    for _ in range(3):
        seen.feed(Delivery(topics.PLANT_STATE.key(CONFIG.name), msgspec.msgpack.encode(fields), 0))
    (event,) = seen.new_events()
    assert event.text == "plant/state: malformed: Object missing required field `source`; not obeyed"
    assert seen.bad.total == 3


def test_a_state_without_bounds_has_an_axis_as_long_as_its_scale() -> None:
    plant = replace(INTEGRATOR, u_max=[math.inf], scale={"speed": 2.0, "push": 2.0})
    monitor = Monitor(CONFIG, plant, 10.0)
    message = m.PlantState(
        run_id="p", seq=0, t=0.0, x=[0.0, 1.0], applied=[9.0], source="command", command_seq=0
    )
    monitor.feed(delivery(topics.PLANT_STATE, message, START))
    gauge = monitor.snapshot(START).states[1]
    assert view._gauge_style(gauge) == "default"
    drawn = view._bar(gauge, 41).plain
    assert (drawn[0], drawn.index("┼"), drawn.index("●"), drawn[-1]) == ("╌", 20, 30, "╌")
    far = replace(gauge, value=1e9)
    assert view._bar(far, 41).plain[-1] == "▶"
    push = monitor.snapshot(START).inputs[0]
    assert view._bar(push, 41).plain[0] == "├"
    assert view._bar(push, 41).plain[-1] == "╌"


def test_who_drives_by_hand_is_said_when_it_begins_and_when_it_ends() -> None:
    seen = Monitor(CONFIG, PLANT, 20.0)
    for k, source in enumerate(["command", "manual", "manual", "plan"]):
        driven = msgspec.structs.replace(state(k), source=source, applied=[1.5 + k])
        seen.feed(delivery(topics.PLANT_STATE, driven, START + k))
        seen.feed(delivery(topics.COMMAND, command(k), START + k))
        now = seen.snapshot(START + k)
        # What is shown of the input is what acts.
        assert (now.inputs[0].value == 1.5 + k) == (source == "manual")
    assert [event.text for event in now.events if "hand" in event.text] == [
        "the plant is driven by hand",
        "the plant is no longer driven by hand: plan",
    ]
