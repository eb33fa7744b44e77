"""`tandem live` on a real bus: a client of its socket receives the bus, and sends nothing to it."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path

import pytest

pytest.importorskip("websockets", reason="pip install 'tandem-control[live]'")

from websockets.asyncio.client import ClientConnection, connect

from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import messages as m
from protocol import topics
from tandem.cli import main
from tandem.web.foxglove_protocol import HEADER, SUBPROTOCOLS
from tests.helpers.live import HANG_S, BusListener, Process, free_endpoint, live_config

pytestmark = pytest.mark.live

LAST = 10_000
TOPICS = ("view/plant/state", "view/bounds", "view/events")


@pytest.fixture
def config() -> Config:
    port = free_endpoint().rpartition(":")[2]
    return live_config(f"live.port={port}")


async def connected(config: Config) -> ClientConnection:
    async with asyncio.timeout(HANG_S):
        while True:
            try:
                at = f"ws://localhost:{config.live.port}/"
                return await connect(at, subprotocols=list(SUBPROTOCOLS))  # type: ignore[arg-type]
            except OSError:
                await asyncio.sleep(0.05)


async def subscribed(socket: ClientConnection) -> dict[int, str]:
    """Subscribe to `TOPICS`; return the topics by subscription number."""
    assert json.loads(await socket.recv())["op"] == "serverInfo"
    advertised = json.loads(await socket.recv())["channels"]
    numbers = {one["id"]: one["topic"] for one in advertised if one["topic"] in TOPICS}
    asked = [{"id": number, "channelId": number} for number in numbers]
    await socket.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
    return numbers


async def hear(socket: ClientConnection, numbers: dict[int, str], topic: str) -> dict:
    """Return the next message of a topic."""
    async with asyncio.timeout(HANG_S):
        while True:
            frame = await socket.recv()
            if isinstance(frame, bytes) and numbers.get(HEADER.unpack_from(frame)[1]) == topic:
                return json.loads(frame[HEADER.size :])


def state(bus: Bus, seq: int) -> m.PlantState:
    return m.PlantState(
        run_id=bus.run_id,
        seq=seq,
        t=float(seq),
        x=[0.5, 1.6, 1.1, 0.0],
        applied=[1.1],
        source="command",
        command_seq=seq,
    )


async def keep_saying(bus: Bus) -> None:
    """Publish states until cancelled: the first ones are sent before the server subscribes."""
    for seq in range(LAST):
        bus.publish(topics.PLANT_STATE, state(bus, seq))
        await asyncio.sleep(0.05)


def test_the_bus_is_received_across_a_restart_and_clients_publish_nothing_on_it(config: Config):
    async def look(bus: Bus, heard: BusListener) -> None:
        socket = await connected(config)
        numbers = await subscribed(socket)
        said = asyncio.create_task(keep_saying(bus))
        first = await hear(socket, numbers, "view/plant/state")
        said.cancel()
        assert first["x"] == {"z": 0.5, "y": 1.6, "r": 1.1, "rdot": 0.0}
        # A late viewer gets the bounds at once, although nothing is published meanwhile.
        late = await connected(config)
        assert (await hear(late, await subscribed(late), "view/bounds"))["x_min"]["z"] == 0.0
        await late.close()
        await socket.send(
            '{"op":"advertise","channels":[{"id":1,"topic":"plant/state","encoding":"json","schemaName":""}]}'
        )
        await socket.send(b"\x01\x01\x00\x00\x00{}")
        refused = 0
        while refused < 2:
            frame = await asyncio.wait_for(socket.recv(), HANG_S)
            refused += isinstance(frame, str) and json.loads(frame)["op"] == "status"
        # An invalid payload is ignored.
        bus._put(topics.PLANT_STATE, b"nonsense")
        bus.publish(topics.PLANT_STATE, state(bus, LAST))
        while (await hear(socket, numbers, "view/plant/state"))["seq"] != LAST:
            pass
        while not any(isinstance(one, m.PlantState) and one.seq == LAST for _, one in heard.heard):
            await asyncio.to_thread(heard.listen, 0.1)
        assert {one.run_id for _, one in heard.heard if isinstance(one, m.PlantState)} == {bus.run_id}
        await socket.close()

    with Process("node_runtime.router", config), Process("tandem.web.main", config) as live:
        for run in ("plant-1", "plant-2"):
            with Bus(config, "plant", run) as bus:
                asyncio.run(look(bus, BusListener(bus)))
        live.signal(signal.SIGTERM)
        assert live.end() == 0


def test_a_second_server_reports_the_used_port_and_the_page_is_served_before_a_router(config: Config):
    async def first_is_there() -> None:
        socket = await connected(config)
        assert json.loads(await socket.recv())["metadata"]["plant"] == config.name
        await socket.close()

    with Process("tandem.web.main", config) as first:
        asyncio.run(first_is_there())
        with Process("tandem.web.main", override(config, ["name=jet2"])) as second:
            assert second.end() == 2
            assert f"live.port {config.live.port} is in use" in second.said
            assert f"--set live.port={config.live.port + 1}" in second.said
        first.signal(signal.SIGTERM)
        assert first.end() == 0


def test_the_layout_can_be_written_to_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "layout.json"
    assert main(["live", "--layout", str(file)]) == 0
    assert "view/plant/state.x.rdot" in file.read_text()
    assert main(["live", "--layout", str(tmp_path)]) == 2
    assert "cannot be written" in capsys.readouterr().err
