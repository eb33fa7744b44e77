"""The checks of the fault suite, and the computation of the facts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.live import stalls
from protocol import messages as m
from tests.verification.calm import CALM, sampled, seen
from verification.faults import evaluation as measured
from verification.faults import holds
from verification.faults.catalogue import ALL
from verification.faults.facts import Replayed


@pytest.mark.parametrize(
    ("check", "bad"),
    [
        (holds.constraints, {"violations": 1}),
        (holds.control_back, {"control_after": 1.2}),
        (holds.control_back, {"control_after": None}),
        (holds.control_kept, {"plan_s": 0.1}),
        (holds.punctual, {"late": 3, "late_by_machine": 2}),
        (holds.no_burst, {"burst": 3}),
        (holds.still_led, {"not_led": 2}),
        (holds.plan_then_safe, {"sources": ["command", "safe", "command"]}),
        (holds.merged, {"samples_held": 198}),
        (holds.merged, {"samples_held": 200}),
        (holds.merged, {"samples_held": None}),
        (holds.readable, {"readable_gap": 0.7}),
        (holds.readable, {"readable_gap": 0.1, "replay": Replayed("DIFFERS", "DIFFERS: x")}),
        (holds.readable, {"readable_gap": 0.1, "log_missing": 1}),
        (holds.replays, {"replay": Replayed("no replay", "no replay: it is empty")}),
        (holds.whole, {"replay": Replayed("exact, with gaps", "exact, but 3 ticks are not in the log")}),
        (holds.none_obeyed, {"foreign_commands": 1}),
        (holds.none_obeyed, {"foreign_states": 1}),
        (
            holds.all_counted,
            {"extra": {"sent plant/state": 2}, "counted": {"controller bad_plant_state_x": 1}},
        ),
        (holds.all_counted, {"counted": {"plant bad_controller_command_foreign": 1}}),
        (
            holds.weights_refused,
            {
                "extra": {"sent trainer/hidden_weights": 3},
                "forged_adopted": 1,
                "errors": [1e-3] * 20 + [2e-4] * 20,
            },
        ),
        (holds.weights_refused, {}),
        (holds.refused_on_both_sides, {}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 1, "said: no": 1}}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 2}}),
        (holds.refused_on_both_sides, {"extra": {"tries": 2, "refused": 2, "said: no": 1}}),
        (holds.view_says, {}),
        (holds.view_said, {}),
        (holds.log_time, {"log_time_off": 3600.0}),
        (holds.as_fast, {"tick_p99_ms": 10.0}),
        (holds.as_good, {"J": 25.3}),
    ],
)
def test_every_check_fails_on_a_bad_run(check: holds.Held, bad: dict[str, Any]) -> None:
    assert check(seen(**bad), CALM)


def test_every_check_passes_on_a_good_run() -> None:
    good = seen(
        late=2,
        late_by_machine=2,
        readable_gap=0.4,
        sources=["command", "plan", "safe", "command"],
        forged_adopted=1,
        errors=[9.0] * 20 + [1.2e-4] * 20,
        extra={
            "sent plant/state": 3,
            "sent trainer/hidden_weights": 2,
            "tries": 4,
            "refused": 4,
            "said: the router refused us": 4,
        },
        counted={
            "controller bad_plant_state_malformed": 2,
            "controller overflow_plant_state": 1,
            "controller bad_trainer_hidden_weights_refused": 2,
            "router bad_tls_link_refused_it_has_no_certificate": 4,
        },
        said=["recorder: NOT LOGGED: full"],
    )
    checks = {held for fault in ALL for held in fault.holds} - {holds.view_says}
    assert [check(good, CALM) for check in checks] == [None] * len(checks)
    assert holds.view_says(seen(view_at_end="recorder silent"), CALM) is None


def test_control_returns_with_the_first_fresh_command_after_the_last_outage() -> None:
    sources = (
        ["command"] * 3
        + ["plan", "safe", "command", "plan", "command", "command"]
        + ["command"] * 20
        + ["plan"]
    )
    motion = [sampled(source, 0.1 * i) for i, source in enumerate(sources)]
    assert measured._control_at(motion, 0.25, 0.45) == pytest.approx(0.7)
    assert measured._control_at(motion[:3], 0.05, None) == 0.05
    assert measured._control_at(motion[:5], 0.25, None) is None
    late = [sampled("plan" if i == 20 else "command", 0.1 * i) for i in range(30)]
    assert measured._control_at(late, 0.25, None) == 0.25


def began(run_id: str, *times: float) -> list[m.Tick]:
    """Ticks that begin at these times, each late as given."""
    return [
        m.Tick(
            run_id=run_id,
            seq=seq,
            slot=seq,
            t=0.0,
            skipped=0,
            lateness=time,
            late=False,
            state_verdict="fresh",
            state=None,
            weights=None,
        )
        for seq, time in enumerate(times)
    ]


def test_a_burst_counts_the_steps_of_one_controller_within_a_period() -> None:
    assert measured._burst(began("controller-1", 0.0, 0.05, 0.1, 0.101, 0.102, 0.15), 0.05) == 3
    one, other = began("controller-1", 0.0, 0.05, 0.075), began("controller-2", 0.0, 0.05, 0.1)
    assert measured._burst(one + other, 0.05) == 2
    assert measured._burst([], 0.05) == 0


def test_a_stall_excuses_the_late_ticks_that_it_overlaps(tmp_path: Path) -> None:
    path = tmp_path / "stalls.txt"
    path.write_text("10.0 0.02\n5.0 0.5\n11.")
    noted = stalls.read(path)
    assert noted == [(5.0, 0.5), (10.0, 0.02)]
    assert stalls.during(noted, 10.01, 10.5)
    assert not stalls.during(noted, 5.6, 9.9)
