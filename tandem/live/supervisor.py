"""`tandem run`: starts every process of the table, watches them, and stops them in order in every case."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType

from node_runtime.bus.zenoh_bus import Bus, Mailbox, OpenInterrupted
from node_runtime.config.sections import Config
from node_runtime.lifecycle import new_run_id
from protocol import topics
from tandem.live.monitor import Monitor
from tandem.live.processes import LIVE, STOP_S, TABLE, Child
from tandem.live.snapshot import Snapshot

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# One Ctrl-C may arrive twice (`timeout`, a shell's process group) and counts once.
SAME_WISH_S = 0.3
BACKOFF_S = (0.5, 1.0, 2.0, 5.0, 10.0)
LONG_LIFE_S = 20.0
SHOW_S = 0.2
GRACE_S = 0.5
EXPLAIN_S = 5.0

Show = Callable[[Snapshot], None]


class Impatient(BaseException):
    """A second stop signal: end everything now."""


class StartError(RuntimeError):
    """A process was not ready in time. `exit_code` is that of the process, None if it still ran or was killed."""

    def __init__(self, text: str, exit_code: int | None = None):
        super().__init__(text)
        self.exit_code = exit_code


@dataclass
class Wish:
    """The stop requests of the person, from signals."""

    stop: bool = False


@contextmanager
def wishes() -> Iterator[Wish]:
    """SIGINT, SIGTERM and SIGHUP set `stop`; a second signal raises `Impatient` at any point of the program."""
    wish, since = Wish(), 0.0

    def handle(_number: int, _frame: FrameType | None) -> None:
        nonlocal since
        if not wish.stop:
            wish.stop, since = True, time.monotonic()
        elif time.monotonic() - since > SAME_WISH_S:
            raise Impatient

    with _signals_go_to(handle):
        yield wish


@contextmanager
def _signals_go_to(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


class Supervisor:
    """Runs the table once. `run` returns why the run ended badly, or None; nothing is left running after it.

    Args:
        config: the configuration of every process; its endpoint must be free.
        config_file: the same as TOML, for the processes.
        folder: for the output of the processes.
        monitor: gets every message on the bus.
        wish: when to stop.
        show: is called about five times a second with a snapshot.
        elsewhere: processes of the table that are not started here.
        live: also serve the run to browsers.
    """

    def __init__(
        self,
        config: Config,
        config_file: Path,
        folder: Path,
        monitor: Monitor,
        wish: Wish,
        show: Show,
        elsewhere: Collection[str] = (),
        live: bool = False,
    ):
        self.config, self.monitor, self.wish, self._show = config, monitor, wish, show
        absent = {*elsewhere, *(() if trains(config) else ("trainer",))}
        table = [process for process in (*TABLE, *([LIVE] if live else [])) if process.name not in absent]
        # The log's name may be any bytes, which a TOML file cannot contain.
        options = {"recorder": ("--log", config.log.path)}
        self.children = {
            process.name: Child(process, config_file, folder, *options.get(process.name, ()))
            for process in table
        }
        self._bus: Bus | None = None
        self._mailbox: Mailbox | None = None
        self._next_show = 0.0
        self._end: Snapshot | None = None
        self._restart_at: dict[str, float] = {}
        self._deaths: dict[str, int] = {}
        self._gone: set[str] = set()
        """Names of dead processes without which the run continues."""

    @property
    def recorder_died(self) -> bool:
        """Whether the log is incomplete."""
        return "recorder" in self._gone

    def run(self) -> str | None:
        """Start, watch and stop all processes. Raises `StartError`, and `Impatient` after all were killed."""
        try:
            try:
                self._start_all()
                trouble = None if self.wish.stop else self._watch()
            except StartError:
                self._stop_all()
                raise
            self._stop_all()
            return trouble
        finally:
            self._kill_all()
            if self._bus is not None:
                self._bus.close(drain_s=0.5)

    # -- starting ----------------------------------------------------

    def _start_all(self) -> None:
        self._start("router")
        self._connect()
        early = [name for name in self.children if name not in ("router", "controller")]
        for name in early:
            self._start(name)
        for name in early:
            if not self.children[name].process.optional:
                self._await_ready(name)
        self._start("controller")
        self._await_ready("controller")

    def _start(self, name: str) -> None:
        if not self.wish.stop:
            self.monitor.forget(name)
            self.children[name].start()

    def _connect(self) -> None:
        """Connect to the router, which also shows that it listens."""
        stop = threading.Event()
        bus = Bus(self.config, "monitor", new_run_id("monitor"), stop)
        opened = threading.Event()

        def connect() -> None:
            try:
                bus.open()
            except (OpenInterrupted, ValueError):
                return
            opened.set()

        threading.Thread(target=connect, name="connect", daemon=True).start()
        router = self.children["router"]
        deadline = time.monotonic() + router.process.ready_s
        try:
            while not opened.wait(0.02) and not self.wish.stop:
                self._fail_if_dead(router)
                if time.monotonic() > deadline:
                    raise self._not_ready(router, "no answer at its endpoint")
        finally:
            stop.set()
        if opened.is_set():
            self._bus, self._mailbox = bus, bus.everything()

    def _await_ready(self, name: str) -> None:
        child = self.children[name]
        self.monitor.phase = f"the {name}"
        deadline = time.monotonic() + child.process.ready_s
        explain_at = time.monotonic() + EXPLAIN_S
        while self.monitor.status(name) not in ("ready", "running") and not self.wish.stop:
            if child.process.slow_because and time.monotonic() > explain_at:
                explain_at = math.inf
                self.monitor.phase = f"the {name}: {child.process.slow_because}"
                self.monitor.say(self.monitor.phase, time.monotonic())
            self._fail_if_dead(*(child for child in self.children.values() if not child.process.optional))
            if time.monotonic() > deadline:
                said = self.monitor.status(name)
                raise self._not_ready(
                    child, f"its last status was {said!r}" if said else "it sent no message"
                )
            self._listen()
        if not self.wish.stop:
            now = time.monotonic()
            self.monitor.say(f"{name} ready after {now - child.started_at:.1f} s", now)

    def _fail_if_dead(self, *children: Child) -> None:
        for child in children:
            if child.exit_code() is not None:
                raise self._not_ready(child, f"it ended with {child.how_it_ended()}")

    def _not_ready(self, child: Child, why: str) -> StartError:
        waited = time.monotonic() - child.started_at
        text = f"the {child.name} was not ready within {waited:.0f} s: {why}"
        words = child.last_words()
        return StartError(f"{text}\n{words}" if words else text, child.exit_code())

    # -- watching ----------------------------------------------------

    def _watch(self) -> str | None:
        """Wait for the end of the run: the time is over, the person stops it, or a process that it needs has died."""
        self.monitor.phase = ""
        slots = max(1.0, self.monitor.seconds * self.config.rate)
        waiting_since = time.monotonic()
        if "plant" not in self.children and self.monitor.first_command is None:
            for text in self._what_a_plant_needs():
                self.monitor.say(text, waiting_since)
        while not self.wish.stop:
            first = self.monitor.first_command
            # The last slot is the exact end; the clock ends the run in any case.
            if self.monitor.slots > slots - 0.5:
                return None
            if first is not None and time.monotonic() >= first + self.monitor.seconds + GRACE_S:
                return None
            if first is None and "plant" in self.children and time.monotonic() > waiting_since + 30.0:
                return "the controller is ready, but no command arrived for 30 s"
            for child in self.children.values():
                if child.exit_code() is not None:
                    trouble = self._died(child)
                    if trouble is not None:
                        return trouble
            self.monitor.miss_plant(time.monotonic())
            self._listen()
        return None

    def _what_a_plant_needs(self) -> tuple[str, str]:
        """Return texts for the person who starts the plant elsewhere: the router's address and the topic."""
        plant, bus = self.monitor.plant, self.config.bus
        places = " or ".join(filter(None, (bus.endpoint, bus.remote)))
        states = f"{plant.d} states ({', '.join(plant.states)}) at {self.config.rate:g} Hz"
        key = topics.PLANT_STATE.key(self.config.name)
        return (
            f"waiting for a plant to connect to the router at {places}",
            f"the plant must publish {states} as {key}",
        )

    def _died(self, child: Child) -> str | None:
        """Handle a dead process; return the text that ends the run, or None if the run continues."""
        now, died = time.monotonic(), f"the {child.name} died ({child.how_it_ended()})"
        if child.process.when_it_dies == "end the run":
            return f"{died}\n{child.last_words()}"
        if child.process.when_it_dies == "go on":
            if child.name not in self._gone:
                self._gone.add(child.name)
                self.monitor.ended(child.name)
                self.monitor.say(self._without(child, died), now, "bad")
            return None
        if child.name not in self._restart_at:
            if now - child.started_at > LONG_LIFE_S:
                self._deaths[child.name] = 0
            deaths = self._deaths.get(child.name, 0)
            wait = BACKOFF_S[min(deaths, len(BACKOFF_S) - 1)]
            self._deaths[child.name] = deaths + 1
            self._restart_at[child.name] = now + wait
            self.monitor.ended(child.name)
            self.monitor.say(f"{died}; it restarts in {wait:g} s", now, "bad")
        elif now >= self._restart_at[child.name]:
            del self._restart_at[child.name]
            self._start(child.name)
        return None

    def _without(self, child: Child, died: str) -> str:
        """Return the report of a dead process without which the run continues."""
        if child.name == "recorder":
            return f"NOT LOGGED from here on: {died}; the loop continues"
        return f"{died}; the run continues without it\n{child.last_words()}"

    def _listen(self, wait_s: float = 0.02) -> None:
        """Process the messages of a short interval together, and update the display from time to time."""
        time.sleep(wait_s)
        if self._mailbox is not None:
            self.monitor.feed_all(self._mailbox.drain())
        now = time.monotonic()
        if self._end is None and now >= self._next_show:
            self._next_show = now + SHOW_S
            self._show(self.monitor.snapshot(now))

    # -- stopping ----------------------------------------------------

    def _stop_all(self) -> None:
        """Stop all processes in order with SIGTERM, then SIGKILL. The display keeps the last state of the run."""
        ended = time.monotonic()
        last = self._end = self.monitor.snapshot(ended)
        for together in STOP_S:
            told = {name: child for name in together if (child := self.children.get(name)) and child.alive()}
            for child in told.values():
                child.signal(signal.SIGTERM)
            asked = time.monotonic()
            for name, child in told.items():
                self._show(replace(last, phase=f"the {name} to stop"))
                while child.alive() and time.monotonic() < asked + together[name]:
                    self._listen(0.01)
                if child.alive():
                    child.signal(signal.SIGKILL)
                    how = f"did not stop within {together[name]:g} s and was killed"
                elif child.exit_code() != 0:
                    how = f"ended with {child.how_it_ended()}"
                else:
                    continue
                self.monitor.say(f"the {name} {how}", time.monotonic(), "bad")
                self._gone.add(name)
        # This includes late messages: the last tick, and errors while stopping.
        frozen = ("states", "inputs", "source", "processes", "phase")
        whole = self.monitor.snapshot(ended)
        self._show(replace(whole, **{name: getattr(last, name) for name in frozen}))

    def _kill_all(self) -> None:
        """Kill all processes that still run. Signals are ignored meanwhile, so that nothing interrupts this."""
        with _signals_go_to(signal.SIG_IGN):
            for child in self.children.values():
                child.signal(signal.SIGKILL)
            for child in self.children.values():
                child.wait(5.0)


def trains(config: Config) -> bool:
    """Whether the configuration needs a trainer."""
    return config.controller.oracle == "dnn" and config.trainer.enabled
