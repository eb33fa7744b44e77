"""A user's two functions behind a gateway, live: commanded, attacked, without commands, failing, killed."""

from __future__ import annotations

import ast
import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

import plant_sim.gateway
from lbmpc.plants import get_plant
from node_runtime.bus.session import session_config
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import to_toml
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.router import open_router
from plant_sim import Gateway
from protocol import codec, topics
from protocol import messages as m
from tests.helpers.interpreter import imported
from tests.helpers.live import (
    HANG_S,
    BusListener,
    Process,
    health_of,
    live_config,
    matched,
    wait_for,
)
from tests.helpers.paths import ROOT

PLANT = get_plant("moore_greitzer")
SAFE = PLANT.safe_input.tolist()
U = float(PLANT.u_e[0])
PERIOD = 0.05


class Machine:
    """A machine at rest that records its inputs and fails as set in `fails`."""

    def __init__(self) -> None:
        self.x: object = PLANT.x_e
        self.fails = ""
        self.written: list[list[float]] = []
        self.go_on = threading.Event()

    def read(self) -> np.ndarray:
        if self.fails == "read hangs":
            self.go_on.wait(HANG_S)
        if self.fails == "read":
            raise OSError("no such device")
        return self.x

    def write(self, u: np.ndarray) -> None:
        if self.fails == "write":
            raise OSError("no such device")
        self.written.append(u.tolist())


@contextmanager
def served(machine: Machine, config: Config) -> Iterator[Gateway]:
    """Run a gateway in a thread and stop it at the end of the block."""
    gateway, stop = Gateway(None, config), threading.Event()
    thread = threading.Thread(target=gateway.serve, args=(machine.read, machine.write, stop))
    thread.start()
    try:
        yield gateway
    finally:
        machine.go_on.set()
        stop.set()
        thread.join(HANG_S)
    assert not thread.is_alive()


class Controller:
    """Sends single commands as a controller does."""

    def __init__(self, bus: Bus, ear: BusListener):
        self._bus, self._ear, self._seq = bus, ear, -1

    def state(self) -> m.PlantState:
        """Return the next sample."""
        self._ear.of(topics.PLANT_STATE)
        state = self._ear.until(lambda message: isinstance(message, m.PlantState))
        assert isinstance(state, m.PlantState)
        return state

    def command(self, u: float, plan: int = 0, **changes: object) -> m.Command:
        """Send a command for the next sample; `changes` make it unacceptable."""
        state = self.state()
        self._seq += 1
        command = m.Command(
            run_id="controller-a",
            seq=self._seq,
            state_run_id=state.run_id,
            state_seq=state.seq,
            period=PERIOD,
            mode="solver",
            u=[u],
            plan=[[u]] * (1 + plan),
        )
        command = msgspec.structs.replace(command, **changes)
        self._bus.publish(topics.COMMAND, command)
        return command


@pytest.mark.live
def test_a_machine_follows_only_valid_commands_and_is_safe_without() -> None:
    # The foreign sender must not take over, however slow this machine is.
    config, machine = live_config("bus.follow_silence=60.0"), Machine()
    with open_router(config), Bus(config, "controller", "controller-a") as bus:
        ear = BusListener(bus)
        hand = Controller(bus, ear)
        foreign = zenoh.open(session_config("client", config.bus.endpoint, config.bus.lease_ms))
        with foreign, served(machine, config):
            ear.until(health_of("plant", status="ready", note="safe input until the first command"))
            wait_for(lambda: matched(bus, topics.COMMAND))
            # The input is written and known from the start, so that labels can be made.
            assert machine.written[0] == SAFE
            ear.until(lambda message: isinstance(message, m.PlantState) and message.applied == SAFE)
            hand.command(99.0)
            wait_for(lambda: machine.written[-1] == PLANT.u_max.tolist())
            hand.command(U + 0.01, plan=3)
            wait_for(lambda: machine.written[-1] == [U + 0.01])
            ear.until(lambda message: isinstance(message, m.PlantState) and message.applied == [U + 0.01])
            # None of these invalid commands is ever written.
            hand.command(0.5, period=0.02)
            hand.command(0.5, state_run_id="plant-b")
            hand.command(0.5, state_seq=0)
            hand.command(0.5, state_seq=-1)
            good = hand.command(0.5, run_id="controller-b")
            payloads = [
                b"garbage",
                codec.encode(good)[:-3],
                codec.encode(msgspec.structs.replace(good, u=[float("nan")])),
                codec.encode(msgspec.structs.replace(good, u=[0.5, 0.5], plan=[[0.5, 0.5]])),
            ]
            for payload in payloads:
                foreign.put(topics.COMMAND.key(config.name), payload)
            reasons = (
                "wrong period",
                "foreign",
                "stale",
                "answers no sample",
                "malformed",
                "not finite",
                "wrong size",
            )
            keys = [m.counter_name("bad controller/command", reason) for reason in reasons]
            health = ear.until(
                lambda message: (
                    isinstance(message, m.Health) and all(message.counters.get(key) for key in keys)
                )
            )
            assert isinstance(health, m.Health)
            # Without further commands the plan ends too.
            ear.until(health_of("plant", note="no fresh command and nothing left to follow: safe input"))
        assert machine.written[-1] == SAFE
        ear.until(health_of("plant", status="stopping"))
    assert all(0.5 not in u for u in machine.written)
    states = ear.of(topics.PLANT_STATE)
    sources = list(dict.fromkeys(state.source for state in states))
    assert [source for source in sources if source != "hold"] == ["safe", "command", "plan"]
    assert [state.seq for state in states] == sorted({state.seq for state in states})
    # Commands act on arrival, in the middle of a period, and the input before them is known.
    assert any(len(state.pieces) == 2 for state in states)


def test_a_machine_is_safe_before_the_first_controller() -> None:
    machine = Machine()
    with served(machine, live_config()):
        wait_for(lambda: machine.written == [SAFE])
    assert machine.written == [SAFE]


@pytest.mark.live
def test_failing_functions_are_reported_in_health_without_invented_data() -> None:
    config, machine = live_config("rate=50.0"), Machine()
    with open_router(config), Bus(config, "controller", "controller-a") as bus:
        ear = BusListener(bus)

        def next_state() -> m.PlantState:
            ear.of(topics.PLANT_STATE)
            state = ear.until(lambda message: isinstance(message, m.PlantState))
            assert isinstance(state, m.PlantState)
            return state

        def well() -> None:
            ear.until(health_of("plant", status="ready"))

        with served(machine, config) as gateway:
            well()
            before = next_state()
            machine.fails = "read"
            health = ear.until(health_of("plant", status="failed"))
            assert isinstance(health, m.Health)
            assert "read failed: OSError: no such device" in health.note
            machine.fails, machine.x = "", [1.0, float("nan"), 0.0, 0.0]
            ear.until(lambda message: isinstance(message, m.Health) and message.counters["reads_failed"] > 20)
            machine.x = PLANT.x_e
            after = next_state()
            assert after.seq - before.seq > 20
            well()
            machine.fails = "write"
            ear.until(
                lambda message: (
                    isinstance(message, m.PlantState) and message.source == "safe" and message.applied is None
                )
            )
            ear.until(health_of("plant", status="failed"))
            machine.fails = ""
            ear.until(lambda message: isinstance(message, m.PlantState) and message.applied == SAFE)
            gateway.new_epoch()
            only_that = [m.Piece(0.0, SAFE)]
            ear.until(lambda message: isinstance(message, m.PlantState) and message.pieces == only_that)
            # On a busy machine one or two samples may be late and lack this input.
            ear.until(lambda message: isinstance(message, m.PlantState) and message.applied == SAFE)
            well()
            # The health thread keeps running while the loop is blocked.
            machine.fails = "read hangs"
            health = ear.until(health_of("plant", status="failed"))
            assert isinstance(health, m.Health)
            assert "read has not returned for more than 1 s" in health.note
            machine.fails = ""
            machine.go_on.set()
            well()
    states = ear.of(topics.PLANT_STATE)
    assert all(state.x == PLANT.x_e.tolist() for state in states)
    assert machine.written[-1] == SAFE


@pytest.mark.live
def test_a_users_machine_is_killed_and_restarted() -> None:
    config = live_config(
        "controller.oracle=linear", "controller.horizon=10", "controller.solver.compile=never"
    )
    with open_router(config), Bus(config, "recorder", "recorder-a") as bus:
        ear = BusListener(bus)

        def driven(run_ids: list[str]) -> str:
            """Wait until a command drives a machine with another run id; return that id."""
            state = ear.until(
                lambda message: (
                    isinstance(message, m.PlantState)
                    and message.run_id not in run_ids
                    and message.source == "command"
                )
            )
            assert isinstance(state, m.PlantState)
            run_id = state.run_id
            ear.until(lambda message: isinstance(message, m.TickResult) and message.h is not None)
            return run_id

        with Process("controller_node.node", config):
            with Process("tests.plant_sim.rig", config) as rig:
                first = driven([])
                rig.signal(signal.SIGKILL)
                rig.end()
            with Process("tests.plant_sim.rig", config) as rig:
                driven([first])
                rig.signal(signal.SIGTERM)
                assert rig.end() == 0
    assert f"left with {SAFE}" in rig.said
    assert "Traceback" not in rig.said
    ticks = {tick.seq: tick for tick in ear.of(topics.TICK)}
    # No label spans the two incarnations.
    for result in ear.of(topics.RESULT):
        now, before = ticks.get(result.seq), ticks.get(result.seq - 1)
        if result.h is not None and now and before and now.state and before.state:
            assert now.state.run_id == before.state.run_id


RIG = """
class Rig:
    x = [0.5, 1.6875, 1.1547, 0.0]
    flow, pressure, throttle, throttle_speed = (lambda self, i=i: self.x[i] for i in range(4))
    def set_throttle(self, u):
        print(u, flush=True)
rig = Rig()
"""


@pytest.mark.live
def test_the_example_in_the_docstring_runs_unchanged(tmp_path: Path) -> None:
    text = ast.get_docstring(ast.parse(Path(plant_sim.gateway.__file__).read_text()))
    assert text is not None
    example = textwrap.dedent(
        "".join(line + "\n" for line in text.splitlines() if line.startswith("    ") or not line)
    )
    assert len(example.split("\n\n")) >= 3
    config = live_config()
    (tmp_path / "tandem.toml").write_text(to_toml(config))
    with open_router(config), Bus(config, "controller", "controller-a") as bus:
        ear = BusListener(bus)
        program = subprocess.Popen(
            [sys.executable, "-c", RIG + example],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            wait_for(lambda: matched(bus, topics.COMMAND))
            Controller(bus, ear).command(U + 0.02)
            ear.until(lambda message: isinstance(message, m.PlantState) and message.source == "command")
            program.send_signal(signal.SIGINT)
            out, err = program.communicate(timeout=HANG_S)
        finally:
            program.kill()
    assert (program.returncode, err) == (0, "")
    written = [float(line) for line in out.splitlines()]
    assert (written[0], written[-1]) == (SAFE[0], SAFE[0])
    assert U + 0.02 in written


def test_a_machine_that_does_not_fit_its_configuration_gives_a_readable_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"plant.x0 has 1 entries"):
        Gateway(PLANT, live_config("plant.x0=[1.0]"))
    (tmp_path / "a.toml").write_text("rates = 3")
    with pytest.raises(ConfigError, match="rate"):
        Gateway(None, tmp_path / "a.toml")


def test_importing_the_package_loads_no_bus() -> None:
    assert not imported("import plant_sim") & {"zenoh", "casadi"}
    assert {"zenoh", "casadi"} <= imported("import plant_sim; plant_sim.Gateway")
