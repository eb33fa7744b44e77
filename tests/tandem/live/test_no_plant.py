"""`tandem run --no-plant` waits for a plant, accepts one without Tandem's code, and then another one."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from node_runtime.bus.zenoh_bus import Bus
from protocol import messages as m
from protocol import topics
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from tests.helpers.launched import launched, small
from tests.helpers.live import BusListener, live_config, matched, wait_for
from tests.helpers.paths import ROOT

pytestmark = pytest.mark.live


@contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen([sys.executable, *command], cwd=ROOT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_a_plant_of_others_comes_and_goes_and_another_one_comes(tmp_path: Path) -> None:
    config = live_config()
    at = config.bus.endpoint
    there = ("--set", f"bus.endpoint={at}")
    with launched(tmp_path, "--no-plant", "--oracle", "constant", *there, *small()) as run:
        run.hears(f"waiting for a plant to connect to the router at {at}")
        run.hears("the plant must publish 4 states (z, y, r, rdot) at 20 Hz as tandem/jet1/plant/state")
        with running("examples/gateway_without_tandem.py", at) as gateway:
            run.hears(" ticks, ", times=2)
            with Bus(config, "controller", "hostile") as bus:
                heard = BusListener(bus)
                state = heard.until(lambda message: isinstance(message, m.PlantState))
                assert isinstance(state, m.PlantState)
                attack = m.Command(
                    run_id="hostile",
                    seq=2**40,
                    state_run_id=state.run_id,
                    state_seq=state.seq,
                    period=config.period,
                    mode="solver",
                    u=[2.0],
                    plan=[[2.0]],
                )
                wait_for(lambda: matched(bus, topics.COMMAND))
                bus.publish(topics.COMMAND, attack)
                bus.publish(topics.COMMAND, msgspec.structs.replace(attack, plan=[[float("nan")]]))
                run.hears("plant: bad controller command foreign; ignored")
                run.hears("plant: bad controller command not finite; ignored")
            gateway.send_signal(signal.SIGKILL)
            run.hears("the plant is silent: no state for")
        with running("-m", "tandem", "plant", *there):
            run.hears("the plant was restarted after")
            run.hears(" ticks, ", times=2, after="the plant was restarted after")
            run.signal(signal.SIGINT)
            code, result = run.ends()
    assert code == 0, run.said
    assert len(result["episodes"]) == 2
    assert result["ticks"] >= 60
    log = read_run(tmp_path / "run.mcap")
    first = [s for s in log.plant_states if s.run_id == log.plant_states[0].run_id]
    assert all(s.x == first[0].x for s in first if s.source == "hold")
    inputs = [piece.u for s in first for piece in s.pieces]
    assert len(inputs) > 20
    assert [2.0] not in inputs
    assert replay(log).equal
