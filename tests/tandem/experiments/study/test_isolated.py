"""A call in a separate process: any failure ends only that process, and the caller continues."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest

from tandem.experiments.study.isolated import Child, Children, Failure, Limits, Unwanted

AMPLE = Limits(seconds=60.0)
FILL = "a = []\nwhile True: a.append(b'x' * (1 << 24))"
PARENT = """
import sys, time
from tandem.experiments.study.isolated import Child, Limits
child = Child()
print(child._process.pid, flush=True)
child.call(exec, "while True: pass", limits=Limits(seconds=100))
"""


@pytest.fixture
def child() -> Iterator[Child]:
    child = Child()
    yield child
    child.kill()


def call(child: Child, *what: Any, limits: Limits = AMPLE) -> Any:
    return child.call(*what, limits=limits)


def test_calls_share_a_process_and_return_their_values(child: Child) -> None:
    assert call(child, max, 2, 5) == 5
    first = call(child, os.getpid)
    assert call(child, os.getpid) == first != os.getpid()


def test_an_exception_is_reported_with_its_traceback_and_the_process_continues(child: Child) -> None:
    failed = call(child, exec, "def f():\n    raise ValueError('not\\nthis')\nf()")
    assert isinstance(failed, Failure)
    assert (failed.kind, failed.text) == ("error", "ValueError: not this")
    assert "line 2, in f" in failed.traceback
    assert call(child, sys.exit, "bye").text == "SystemExit: bye"
    assert call(child, max, 2, 5) == 5


@pytest.mark.parametrize(
    ("what", "why"),
    [
        ((os._exit, 3), "ended with exit code 3"),
        ((os.abort,), "killed by SIGABRT"),
        ((exec, "import os; os.kill(os.getpid(), 9)"), "killed by SIGKILL, perhaps by the system because memory"),
    ],
    ids=["exit", "abort", "kill"],
)  # fmt: skip
def test_a_crash_is_reported(child: Child, what: tuple[Any, ...], why: str) -> None:
    failed = call(child, *what)
    assert isinstance(failed, Failure)
    assert failed.kind == "crash"
    assert why in failed.text
    assert not child.usable


@pytest.mark.parametrize("endless", ["while True: pass", "import time; time.sleep(600)"])
def test_a_call_that_never_ends_is_stopped(child: Child, endless: str) -> None:
    failed = call(child, exec, endless, limits=Limits(seconds=0.5))
    assert failed.kind == "time"
    assert failed.text == "stopped: it did not end within 0.5 s"
    assert not child.usable


def test_a_call_that_fills_the_memory_is_stopped(child: Child) -> None:
    failed = call(child, exec, FILL, limits=Limits(seconds=60.0, memory_gib=0.25))
    assert failed.kind == "memory"
    assert "0.25 GiB" in failed.text


def test_a_call_that_is_no_longer_wanted_is_stopped(child: Child) -> None:
    ends = time.monotonic() + 0.5
    with pytest.raises(Unwanted):
        child.call(time.sleep, 600, limits=AMPLE, wanted=lambda: time.monotonic() < ends)
    assert not child.usable


def test_ctrl_c_does_not_reach_a_call(child: Child) -> None:
    program = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)"
    assert call(child, exec, program) is None


def test_a_crash_leaves_a_new_process_for_the_next_call() -> None:
    children = Children()
    try:
        with children.one() as child:
            assert call(child, os._exit, 1).kind == "crash"
        with children.one() as child:
            assert call(child, max, 2, 5) == 5
    finally:
        children.kill()


def test_a_process_that_is_started_while_all_are_ended_is_ended_too() -> None:
    children = Children()
    children.kill()
    with children.one() as child:
        assert call(child, time.sleep, 600).kind == "crash"
    children.kill()


def test_a_child_ends_with_its_parent() -> None:
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    handle = os.pidfd_open(child)
    try:
        parent.send_signal(signal.SIGKILL)
        parent.wait()
        ends = time.monotonic() + 60.0
        while time.monotonic() < ends:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, 0)
                time.sleep(0.05)
                continue
            return
        raise AssertionError("the child is still there")
    finally:
        os.close(handle)
