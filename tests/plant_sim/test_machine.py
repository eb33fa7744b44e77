"""Two functions that fail in every way: the loop around them reports it and continues."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest

from lbmpc.plants import PlantError
from node_runtime.realtime import clock
from plant_sim import machine
from plant_sim.machine import Guarded, NotMeasured
from tests.helpers.live import wait_for


def guarded(
    read: Callable[[], object] = lambda: [1.0, 2.0],
    write: Callable[[np.ndarray], object] = lambda u: None,
    period: float = 10.0,
    simulated: bool = False,
) -> Guarded:
    return Guarded(read, write, 2, period, simulated)


def raising(error: BaseException) -> Callable[..., None]:
    def function(*_: object) -> None:
        raise error

    return function


def test_a_reading_is_copied_and_may_be_any_numbers() -> None:
    mine = np.array([1, 2])
    x = guarded(lambda: mine).read(3.0)
    assert x is not None
    mine[0] = 9
    assert x.tolist() == [1.0, 2.0]


def test_a_function_that_modifies_its_input_does_not_change_the_record() -> None:
    u = np.array([0.5])
    since = guarded(write=lambda given: given.fill(9.0)).write(u, 3.0)
    assert since is not None
    assert u.tolist() == [0.5]


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (raising(OSError("no such device")), "read failed: OSError: no such device"),
        (lambda: [1.0], "x has the shape (1,), but the plant has 2 states"),
        (lambda: [[1.0], [2.0]], "x has the shape (2, 1), but the plant has 2 states"),
        (lambda: [1.0, float("nan")], "x is not finite"),
        (lambda: [1.0, float("inf")], "x is not finite"),
        (lambda: None, "shape ()"),
        (lambda: "flow", "could not convert"),
    ],
)
def test_invalid_measurements_are_rejected(
    read: Callable[[], object], said: str, caplog: pytest.LogCaptureFixture
) -> None:
    one = guarded(read)
    for _ in range(3):
        assert one.read(0.0) is None
    assert one.counts["reads_failed"] == 3
    assert said in one.trouble()
    # It is logged once, however often it fails.
    assert len(caplog.records) == 1


def test_with_an_estimator_some_states_may_have_no_number() -> None:
    def read(x: list[float]) -> np.ndarray | None:
        return Guarded(lambda: np.array(x), lambda u: None, 2, 10.0, False, gaps=True).read(0.0)

    nan = float("nan")
    np.testing.assert_array_equal(read([1.0, nan]), [1.0, nan])
    assert read([nan, nan]) is None
    assert read([float("inf"), nan]) is None


def test_a_failed_write_makes_the_input_unknown() -> None:
    one = guarded(write=raising(TimeoutError("bus")))
    assert one.write(np.zeros(1), 0.0) is None
    assert one.counts["writes_failed"] == 1
    assert one.trouble() == "write failed: TimeoutError: bus"


def test_a_fault_ends_if_it_does_not_recur(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(clock, "now", lambda: now)
    one = guarded(raising(OSError("a")))
    one.read(0.0)
    now += machine.REMEMBERED_S + 0.1
    assert one.trouble() == ""


def test_a_lost_machine_ends_the_loop() -> None:
    with pytest.raises(PlantError, match="gone"):
        guarded(raising(PlantError("gone"))).read(0.0)


def test_an_error_in_a_simulation_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        guarded(raising(ZeroDivisionError("dt")), simulated=True).read(0.0)


def test_a_call_takes_effect_when_made_or_in_simulation_when_due() -> None:
    for simulated in (False, True):
        one = guarded(simulated=simulated)
        before = clock.now()
        one.read(3.0)
        since = one.write(np.zeros(1), 4.0)
        assert since is not None
        assert (
            (one.measured, since) == (3.0, 4.0)
            if simulated
            else before <= one.measured <= since <= clock.now()
        )


def test_a_slow_call_is_counted() -> None:
    one = guarded(write=lambda u: clock.sleep_until(clock.now() + 0.02), period=0.01)
    one.write(np.zeros(1), 0.0)
    assert (one.counts["writes_slow"], one.counts["reads_slow"]) == (1, 0)


def test_a_call_that_hangs_is_visible_to_other_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "HANGS_S", 0.05)
    go_on = threading.Event()
    one = guarded(lambda: [go_on.wait(60.0), 1.0])
    calling = threading.Thread(target=one.read, args=(0.0,))
    calling.start()
    try:
        wait_for(lambda: "read has not returned" in one.trouble())
    finally:
        go_on.set()
        calling.join()
    assert one.trouble() == ""


def test_a_deliberately_lost_sample_is_not_a_failure() -> None:
    def lost() -> np.ndarray:
        raise NotMeasured

    for simulated in (True, False):
        one = Guarded(lost, lambda _u: None, 2, 0.05, simulated)
        assert one.read(0.0) is None
        assert one.counts["reads_failed"] == 0
        assert one.trouble() == ""
