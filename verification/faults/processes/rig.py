"""One run of the real processes, with faults on request. It restarts processes that die, as a supervisor does."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import msgspec

from benchmarks.live import stalls
from benchmarks.live.ports import free_port
from node_runtime.bus.zenoh_bus import Bus, Mailbox
from node_runtime.config.loading import override, to_toml
from node_runtime.config.sections import Config
from node_runtime.lifecycle import new_run_id
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol import messages as m
from tandem.live.processes import command_line
from verification.faults.processes import link as links
from verification.faults.processes.running import Event, Heard, Running
from verification.faults.processes.scenes import Surroundings

HERE = Path(__file__).parent
ROOT = HERE.parent.parent.parent
COMMANDS = {
    "router": "router",
    "recorder": "record",
    "trainer": "trainer",
    "controller": "controller",
    "plant": "",
}
STOP_ORDER = ("controller", "plant", "trainer", "recorder", "router")
RESTARTED = ("router", "trainer", "controller")
"""A dead recorder is not restarted, as under `tandem run`, because its log must not be overwritten."""
RESTART_S = 0.5
"""Seconds that `tandem run` waits before it restarts a dead process."""
READY_S = 60.0
STOP_S = 8.0
LOOK_S = 0.01
LISTENING = "router listening on"

Place = Literal["loopback", "veth", "wire"]


class RigError(RuntimeError):
    """The run failed for reasons other than the fault: a process did not start, or no command came."""


class Rig:
    """A router, recorder, trainer, controller and plant, started on entry, all gone on exit.

    Args:
        folder: everything is written here: configurations, outputs, the log, the plant's trace.
        config: the run's; endpoint and log are set here.
        places: where "plant" and "trainer" are: beside the others, as the rest is, or behind a link.
        around: what its scene adds to environment and configurations.
        seed: of what happens on a lossy link.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        places: dict[str, Place] | None = None,
        *,
        around: Surroundings | None = None,
        seed: int = 0,
    ):
        self.folder, self._places = folder, places or {}
        self._seed, self._around = seed, around or Surroundings()
        port = free_port()
        while f":{port}" in str(self._around.settings):
            # The scene's endpoint for other machines has this port, although no router listens there yet.
            port = free_port()
        self.config = override(
            config,
            [
                f'bus.endpoint="tcp/127.0.0.1:{port}"',
                f'log.path="{folder / "disk" / "run.mcap"}"',
                f'controller.checkpoint="{folder / "controller.checkpoint"}"',
            ],
        )
        self.log = folder / "disk" / "run.mcap"
        self.trace = folder / "trace.jsonl"
        self.heard: list[Heard] = []
        self.events: list[Event] = []
        self.first_command: float | None = None
        self.processes: dict[str, Running] = {}
        self.links: dict[str, links.Link] = {}
        self._port = port
        self._stack = ExitStack()
        self._mailbox: Mailbox | None = None
        self._command_key = topics.COMMAND.name
        self.restarts = True
        self.door: str | None = None
        """Address at which the router listens for other machines."""
        self.ended_at = math.inf
        """When all processes were told to stop."""
        self.listening_at: dict[int, float] = {}
        """When the router listened after its n-th start."""

    # -- begin and end -----------------------------------------------

    def __enter__(self) -> Rig:
        try:
            self._begin()
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _begin(self) -> None:
        (self.folder / "disk").mkdir(parents=True, exist_ok=True)
        for number, (name, place) in enumerate(self._places.items()):
            if place != "loopback":
                self.links[name] = self._stack.enter_context(links.link(place, number, self._seed))
        self._stack.callback(self._kill_all)
        for name in COMMANDS:
            self.processes[name] = self._prepare(name)
        self._stack.enter_context(stalls.watched(self.folder / "stalls.txt", self.config.realtime.priority))
        for name, running in self.processes.items():
            if name != "controller":
                running.start()
        deadline = clock.now() + READY_S
        while LISTENING not in self.processes["router"].said():
            if clock.now() > deadline or not self.processes["router"].alive:
                raise RigError(f"the router did not start: {self.processes['router'].said()[-800:]}")
            clock.sleep_until(clock.now() + LOOK_S)
        bus = Bus(self.config, "monitor", new_run_id("witness"))
        bus.open()
        self._stack.callback(bus.close, 0.5)
        self._mailbox = bus.everything()
        # The log begins with the memory with which the controller begins.
        self.wait(lambda: self._ready("recorder"), READY_S, "the recorder ready")
        self.processes["controller"].start()
        self.wait(
            lambda: all(self._ready(name) for name in COMMANDS if name != "plant"), READY_S, "all ready"
        )
        plant = self.processes["plant"].popen
        assert plant is not None
        assert plant.stdin is not None
        plant.stdin.write(b"begin\n")
        plant.stdin.flush()
        self.wait(lambda: self.first_command is not None, READY_S, "the first command")

    def _prepare(self, name: str) -> Running:
        """Describe the process; the router's address depends on the place, so each has its own configuration."""
        config = self.config
        prefix: list[str] = []
        if name in self.links:
            prefix = self.links[name].prefix
            config = override(config, [f'bus.endpoint="tcp/{self.links[name].here}:{self._port}"'])
        elif name == "router" and self.links:
            config = override(config, [f'bus.endpoint="tcp/0.0.0.0:{self._port}"', "bus.insecure=true"])
        config = override(config, self._around.settings.get(name, []))
        if name == "router":
            self.door = config.bus.remote
        file = self.folder / f"{name}.toml"
        file.write_text(to_toml(config), encoding="utf-8")
        if name == "plant":
            words = [
                sys.executable,
                str(HERE / "traced_plant.py"),
                str(os.getpid()),
                str(file),
                str(self.trace),
            ]
        else:
            words = command_line(COMMANDS[name], file)
        return Running(name, [*prefix, *words], self._around.environment, self.folder / f"{name}.txt")

    def end(self) -> None:
        """Stop all in the order of a supervisor; a process that does not stop is killed, which is an event."""
        self.restarts = False
        self.ended_at = clock.now()
        for name in STOP_ORDER:
            running = self.processes[name]
            running.signal(signal.SIGTERM)
            deadline = clock.now() + STOP_S
            while running.alive and clock.now() < deadline:
                self.look()
            if running.alive:
                self.note(f"{name} did not stop", name)
                running.signal(signal.SIGKILL)

    def _kill_all(self) -> None:
        for running in self.processes.values():
            running.signal(signal.SIGKILL)
        for running in self.processes.values():
            if running.popen is not None:
                running.popen.communicate()

    # -- time ----------------------------------------------------------

    def look(self) -> None:
        """Take a hundredth of a second: read messages, and restart dead processes."""
        clock.sleep_until(clock.now() + LOOK_S)
        assert self._mailbox is not None
        prefix = topics.everything(self.config.name).removesuffix("**")
        for delivery in self._mailbox.drain():
            at, topic = delivery.received_ns * 1e-9, delivery.key.removeprefix(prefix)
            if self.first_command is None and topic == self._command_key:
                self.first_command = at
            self.heard.append(Heard(at, topic, delivery.payload))
        router = self.processes["router"]
        if (starts := len(router.started)) not in self.listening_at and router.said().count(
            LISTENING
        ) >= starts:
            self.listening_at[starts] = clock.now()
        for name in RESTARTED if self.restarts else ():
            running = self.processes[name]
            if not running.started or running.alive:
                continue
            if running.restart_at is None:
                running.restart_at = clock.now() + RESTART_S
            elif clock.now() >= running.restart_at:
                running.restart_at = None
                running.start()
                self.note(f"{running.name} started again", running.name)

    def run_for(self, seconds: float) -> None:
        """Let the run go on."""
        self.run_until(clock.now() + seconds)

    def run_until(self, moment: float) -> None:
        """Let the run continue until `moment` on the monotonic clock."""
        while clock.now() < moment:
            self.look()

    def wait(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Let the run continue until a condition holds. Raises `RigError` if it does not hold in time."""
        deadline = clock.now() + timeout_s
        while not condition():
            if clock.now() > deadline:
                dead = [f"{p.name}:\n{p.said()[-800:]}" for p in self.processes.values() if not p.alive]
                raise RigError(f"not within {timeout_s:g} s: {what}. {' '.join(dead)}")
            self.look()

    # -- faults --------------------------------------------------------

    def note(self, text: str, *concerns: str, whole_again: bool = False) -> None:
        """Record an event at this moment."""
        self.events.append(Event(clock.now(), text, concerns, whole_again))

    def kill(self, *names: str) -> None:
        """Kill these processes at once, with kill -9."""
        self.note(f"kill {' and '.join(names)}", *names)
        for name in names:
            self.processes[name].killed.append(clock.now())
            self.processes[name].signal(signal.SIGKILL)

    def await_restarted(self, timeout_s: float) -> None:
        """Let the run continue until every restarted process has published, at most for `timeout_s`."""
        killed = [name for name in RESTARTED if self.processes[name].killed]
        deadline = clock.now() + timeout_s
        while clock.now() < deadline and not all(self.back_at(name) for name in killed):
            self.look()

    def back_at(self, name: str) -> float | None:
        """When a killed process published again; None: not yet."""
        running = self.processes[name]
        if len(running.started) <= len(running.killed):
            return None
        if name == "router":
            # The router's first message travels through itself, so its own output is the earliest evidence.
            return self.listening_at.get(len(running.started))
        return next((at for at, _ in self.health(name) if at > running.started[-1]), None)

    def freeze(self, name: str, seconds: float) -> None:
        """Send SIGSTOP, and SIGCONT later."""
        self.note(f"stop {name}", name)
        self.processes[name].signal(signal.SIGSTOP)
        self.run_for(seconds)
        self.processes[name].signal(signal.SIGCONT)
        self.note(f"{name} goes on", name, whole_again=True)

    def shape(self, name: str, shape: links.Shape, seconds: float) -> None:
        """Apply a shape to the packets of the plant's or the trainer's link for a while."""
        self.note(f"{name}'s link: {shape}")
        self.links[name].shape(shape)
        self.run_for(seconds)
        self.links[name].shape(links.Shape())
        self.note(f"{name}'s link is back", whole_again=True)

    def attack(self, kind: str, rate: float, seconds: float, seed: int) -> dict[str, float]:
        """Let a stranger send bad messages for a while; return how many it sent, by topic."""
        sent = self._beside(
            "attacker", self.config, kind, str(rate), str(seconds), str(seed), seconds=seconds
        )
        return {f"sent {topic}": count for topic, count in sent.items()}

    def knock(self, kind: str, folder: Path, seconds: float) -> dict[str, float]:
        """Let a stranger try the router's endpoint for other machines for a while; return what it was told."""
        far = override(self.config, [f'bus.endpoint="{self.door}"'])
        return self._beside("stranger", far, kind, str(folder), str(seconds), seconds=seconds)

    def _beside(
        self, program: str, config: Config, kind: str, *words: str, seconds: float
    ) -> dict[str, float]:
        """Run one of `strangers` beside the run until it ends; return the counts that it prints."""
        file = self.folder / f"{program}.toml"
        file.write_text(to_toml(config), encoding="utf-8")
        command = [sys.executable, "-m", f"verification.faults.strangers.{program}", str(file), kind, *words]
        self.note(f"{program}: {kind}")
        out, err = self.folder / f"{program}.json", self.folder / f"{program}.txt"
        with out.open("wb") as stdout, err.open("wb") as stderr:
            process = subprocess.Popen(command, stdout=stdout, stderr=stderr, cwd=ROOT)
            self._stack.callback(process.wait)
            self._stack.callback(process.kill)
            self.wait(lambda: process.poll() is not None, seconds + 15.0, f"the {program}'s end")
        if process.returncode:
            raise RigError(f"the {program} failed: {err.read_text()[-800:]}")
        self.note("that is over", whole_again=True)
        return msgspec.json.decode(out.read_bytes(), type=dict[str, float])

    # -- what is known while it runs -------------------------------------

    def health(self, process: str) -> list[tuple[float, m.Health]]:
        """Return all health messages of a process so far, and when they were received."""
        topic = topics.HEALTH[process]
        return [
            (heard.at, message)
            for heard in self.heard
            if heard.topic == topic.name and isinstance(message := _decoded(topic, heard), m.Health)
        ]

    def _ready(self, name: str) -> bool:
        return any(health.status in ("ready", "running") for _, health in self.health(name))


def _decoded(topic: topics.Topic, heard: Heard) -> m.Message | None:
    try:
        return codec.decode(topic, heard.payload)
    except codec.BadMessage:
        return None
