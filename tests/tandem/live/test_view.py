"""The live view shows the monitor's data and fits every terminal."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import msgspec
import pytest
from rich.console import Console

from protocol import messages as m
from protocol import topics
from tandem.live import view
from tandem.live.monitor import Monitor
from tandem.live.snapshot import Snapshot
from tests.helpers.plants.integrator import INTEGRATOR
from tests.tandem.live.heard import CONFIG, PLANT, START, command, delivery, result, state


def drawn(now: Snapshot, width: int, height: int) -> list[str]:
    console = Console(width=width, height=height, file=io.StringIO(), force_terminal=True, color_system=None)
    with console.capture() as capture:
        console.print(view.render(now, width, height))
    return capture.get().splitlines()


@pytest.mark.parametrize(("width", "height"), [(100, 30), (80, 24), (60, 24), (60, 50), (40, 20), (200, 60)])
def test_fits(monitor: Monitor, width: int, height: int):
    for now in (monitor.snapshot(START + 2.5), Monitor(CONFIG, PLANT, 20.0).snapshot(START)):
        lines = drawn(now, width, height)
        assert max(map(len, lines)) <= width
        assert len(lines) <= height


def test_the_view_shows_states_bounds_input_and_counters(monitor: Monitor):
    text = "\n".join(drawn(monitor.snapshot(START + 2.5), 100, 30))
    for expected in (
        "0.3000",
        "20.00 Hz",
        "1 late",
        "2 skipped",
        "1 fallback",
        "1 soft ticks",
        "1 adopted",
        "bad plant state not finite 2",
        "2.5 / 20 s",
        "●",
    ):
        assert expected in text


@pytest.mark.parametrize(("z", "mark"), [(-0.4, "◀"), (1.7, "▶"), (0.5, "●")])
def test_a_value_outside_its_bounds_is_marked(z: float, mark: str):
    seen = Monitor(CONFIG, PLANT, 20.0)
    seen.feed(delivery(topics.PLANT_STATE, state(0, z), START))
    assert mark in "\n".join(drawn(seen.snapshot(START), 100, 30))


def test_a_sensor_fault_is_reported_once_and_shown(monitor: Monitor) -> None:
    stuck = {"y": "stuck; what it measures is estimated from the others"}
    for k, faults in ((50, stuck), (51, stuck), (52, {})):
        answer = msgspec.structs.replace(result(k), sensor_faults=faults)
        monitor.feed(delivery(topics.RESULT, answer, START + 0.05 * k))
        if k == 51:
            now = monitor.snapshot(START + 2.6)
            assert "sensor y is stuck since 2.5 s; what it measures is estimated" in view.line(now)
            assert "not trusted" in "\n".join(drawn(now, 120, 40))
    said = [event.text for event in monitor.snapshot(START + 2.7).events if "sensor" in event.text]
    assert said == [
        "tick 50: sensor y is stuck since 2.5 s; what it measures is estimated from the others",
        "tick 52: sensor y is trusted again",
    ]


def test_events_report_when_learning_adds_nothing_and_when_it_counts_again() -> None:
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
    assert "learning has an effect again" in events


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


def test_the_plain_view_is_one_line(monitor: Monitor):
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


def test_a_silent_plant_and_its_return_are_reported() -> None:
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
    assert said()[-1] == "the plant was restarted after 5.0 s as q: a new episode"


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
