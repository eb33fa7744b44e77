"""`tandem manual` and `tandem auto` at a gateway on a router, and the messages that end a session."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from lbmpc.plants import Known, get_plant
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override, to_toml
from node_runtime.config.sections import Config
from node_runtime.router import open_router
from plant_sim import Gateway
from protocol import messages as m
from protocol import topics
from tandem import certificate_authority
from tandem.cli import main
from tandem.operating.hand_session import Follower, assignments, clipped, completed, lease_of, line
from tandem.terminal import Refused
from tests.helpers.certificates import issue
from tests.helpers.live import BusListener, free_endpoint, live_config, wait_for

PLANT = get_plant("moore_greitzer")
U = float(PLANT.u_e[0])


class Machine:
    """A machine that does not move for any input."""

    def __init__(self) -> None:
        self.written: list[float] = []
        self.x = PLANT.x_e

    def read(self) -> np.ndarray:
        return self.x

    def write(self, u: np.ndarray) -> None:
        self.written.append(float(u[0]))


@contextmanager
def served(config: Config) -> Iterator[Machine]:
    """Serve a gateway at a router, without a controller."""
    machine, stop = Machine(), threading.Event()
    thread = threading.Thread(target=Gateway(None, config).serve, args=(machine.read, machine.write, stop))
    with open_router(config):
        thread.start()
        try:
            yield machine
        finally:
            stop.set()
            thread.join()


@contextmanager
def by_hand(*arguments: str) -> Iterator[list[int]]:
    """Run `tandem manual` during the block; yield a list that gets its exit code."""
    code: list[int] = []
    session = threading.Thread(target=lambda: code.append(main(["manual", *arguments])))
    session.start()
    try:
        yield code
    finally:
        session.join()


@pytest.mark.live
def test_manual_control_of_a_machine(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = live_config()
    file = tmp_path / "a.toml"
    file.write_text(to_toml(config))
    at = ["--config", str(file)]
    with served(config) as machine, Bus(config, "recorder", "r-1") as bus:
        ear = BusListener(bus)
        assert main(["manual", f"u={U + 0.02}", "--seconds", "1.5", *at]) == 0
        said = capsys.readouterr().out
        assert "manual control ended" in said
        assert "manual" in said
        assert U + 0.02 in machine.written
        # An input from which X could not be kept never acts: the plant names the state and the time.
        machine.x = PLANT.x0
        assert main(["manual", "u=99", "--seconds", "9", *at]) == 1
        assert "would leave X within" in capsys.readouterr().out
        assert PLANT.u_max[0] not in machine.written
        machine.x = PLANT.x_e
        # From another sender.
        with by_hand(f"u={U + 0.03}", "--seconds", "30", *at) as code:
            wait_for(lambda: machine.written[-1] == U + 0.03)
            assert main(["auto", *at]) == 0
        assert code == [1]
        assert "returned the plant to the controller" in capsys.readouterr().out
        states = ear.of(topics.PLANT_STATE)
        notes = {one.note for name, one in ear.heard if name == topics.HEALTH["plant"].name}
    assert {state.source for state in states} - {"hold"} == {"safe", "manual"}
    # On a busy machine many periods are incomplete.
    assert [U + 0.02] in [state.applied for state in states if state.source == "manual"]
    assert any(note.startswith("under manual control (commander-") for note in notes)


@pytest.mark.live
def test_manual_control_needs_a_commander_certificate_and_ends_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keys = tmp_path / "jet1"
    certificate_authority.create("jet1", [], keys, 30)
    remote = free_endpoint().replace("tcp/", "tls/")
    local = live_config(f'bus.remote="{remote}"', f'bus.tls.keys="{keys / "router"}"')

    def far(role: str) -> list[str]:
        config = override(
            local, [f'bus.endpoint="{remote}"', f'bus.tls.keys="{keys / role}"', 'bus.remote=""']
        )
        file = tmp_path / f"{role}.toml"
        file.write_text(to_toml(config))
        return ["--config", str(file)]

    with served(local) as machine:
        assert main(["manual", f"u={U + 0.01}", *far("viewer")]) == 2
        assert "is the certificate of viewer.jet1" in capsys.readouterr().err
        issue(keys, "brief", "commander.jet1", 4.0 / 86400.0)
        with by_hand(f"u={U + 0.02}", "--seconds", "5", *far("brief")):
            wait_for(lambda: U + 0.02 in machine.written)
            # The session repeats its message, but the expired certificate cuts the link: the lease ends.
            wait_for(lambda: machine.written[-1] != U + 0.02)


def state(seq: int, source: str = "command", run_id: str = "plant-1") -> m.PlantState:
    return m.PlantState(
        run_id=run_id, seq=seq, t=0.0, x=PLANT.x_e.tolist(), applied=[U], source=source, command_seq=0
    )  # fmt: skip


def begun() -> Follower:
    """Return the follower of a manual session that the plant has accepted."""
    follower = Follower("me", m.Override)
    follower.take(state(7))
    follower.said()
    for seq in (8, 9):
        assert follower.take(state(seq, "command" if seq == 8 else "manual")) == ""
    assert follower.begun
    return follower


def word(mode: str, seq: int, run_id: str) -> m.Override:
    return m.Override(run_id=run_id, seq=seq, mode=mode, u=[U] if mode == "manual" else [])


def test_events_that_end_a_manual_session() -> None:
    assert begun().take(word("manual", 0, "other")) == "other took over"
    assert begun().take(word("auto", 0, "other")) == "other returned the plant to the controller"
    assert begun().take(state(10)) == "the plant is no longer under manual control"
    assert begun().take(state(0, "safe", "plant-2")) == "the gateway was restarted"
    for none in (word("manual", 5, "other"), word("auto", 3, "me"), state(10, "manual")):
        assert begun().take(none) == ""


def test_an_earlier_manual_session_is_not_taken_for_ones_own() -> None:
    follower = Follower("me", m.Override)
    follower.take(state(7, "manual"))
    follower.said()
    follower.take(state(8, "manual"))
    assert not follower.begun
    follower.take(state(9, "manual"))
    assert follower.begun


def test_events_that_end_a_pause() -> None:
    for message, why in (
        (word("auto", 0, "other"), "other returned the plant to the controller"),
        (m.Reference(run_id="other", seq=3), "other gave another reference"),
        (word("manual", 0, "other"), ""),
        (m.Reference(run_id="me", seq=3), ""),
    ):
        follower = Follower("me", m.Reference)
        follower.said()
        assert follower.take(message) == why


def test_inputs_are_named_and_the_others_stay() -> None:
    assert assignments(["u=1.2"], PLANT) == {"u": 1.2}
    for text, says in (("v=1", "no input 'v'; it has u"), ("u", "with a finite number"), ("u=inf", "finite")):
        with pytest.raises(Refused, match=says):
            assignments([text], PLANT)
    scale = {"x1": 1.0, "a": 1.0, "b": 1.0}
    two = Known.from_matrices([[-1.0]], [[1.0, 1.0]], W=[0.0], inputs=("a", "b"), scale=scale)
    assert completed({"b": 3.0}, two, [1.0, 2.0]).tolist() == [1.0, 3.0]
    with pytest.raises(Refused, match="give values for a too"):
        completed({"b": 3.0}, two, None)


def test_inputs_that_the_gateway_clips_are_reported() -> None:
    assert clipped(np.array([2000.0]), PLANT) == f"; outside of U, u is clipped to {PLANT.u_max[0]:g}"
    assert clipped(PLANT.u_max, PLANT) == ""


def test_a_line_has_the_acting_input_and_the_nearest_bound() -> None:
    said = line(state(3, "manual"), PLANT, 2.0)
    assert "2.0 s  manual" in said
    assert "u 1.1547  |  margin" in said
    assert [lease_of(period) for period in (0.05, 5.0, 100.0)] == [1.0, 15.0, 60.0]
