"""The server on a port of this machine, with browsers, programs and invalid clients."""

from __future__ import annotations

import asyncio
import json
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

pytest.importorskip("websockets", reason="pip install 'tandem-control[live]'")

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import InvalidStatus

from run_log.views.channel import Channel, document, leaf
from tandem.web import server
from tandem.web.audience import Audience
from tandem.web.foxglove_protocol import HEADER, SUBPROTOCOLS
from tandem.web.page import page
from tandem.web.server import Document, serving

STATE = Channel("plant/state", document("state", {"t": leaf("number")}, ["t"]))
SUBSCRIBE = json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 1}]})
PATIENCE_S = 30.0


@asynccontextmanager
async def served() -> AsyncIterator[tuple[Audience, str]]:
    audience = Audience("jet1", "s", {}, lambda _topic: 0)
    audience.advertise(STATE)
    async with serving(audience, {"/": page(), "/a.json": Document("application/json", b"{}")}, 0) as port:
        yield audience, f"127.0.0.1:{port}"


def client(at: str, **more: object) -> connect:
    return connect(f"ws://{at}/", **{"subprotocols": list(SUBPROTOCOLS), **more})  # type: ignore[arg-type]


async def subscribed(socket: ClientConnection, audience: Audience) -> None:
    before = sum(bool(viewer.subscriptions) for viewer in audience.viewers)
    assert json.loads(await socket.recv())["op"] == "serverInfo"
    assert json.loads(await socket.recv())["op"] == "advertise"
    await socket.send(SUBSCRIBE)
    async with asyncio.timeout(PATIENCE_S):
        while sum(bool(viewer.subscriptions) for viewer in audience.viewers) == before:
            await asyncio.sleep(0.01)


def get(at: str, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    request = urllib.request.Request(f"http://{at}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, dict(answer.headers), answer.read()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read()


@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
def test_a_client_subscribes_and_hears(subprotocol: str):
    async def run() -> None:
        async with served() as (audience, at), client(at, subprotocols=[subprotocol]) as socket:
            assert socket.subprotocol == subprotocol
            await subscribed(socket, audience)
            audience.publish(STATE, 123, b'{"t":1}')
            frame = await asyncio.wait_for(socket.recv(), PATIENCE_S)
            assert isinstance(frame, bytes)
            assert HEADER.unpack_from(frame) == (1, 7, 123)
            assert frame[HEADER.size :] == b'{"t":1}'

    asyncio.run(run())


def test_a_page_of_another_origin_or_name_is_refused_before_it_hears_anything():
    async def run() -> None:
        async with served() as (audience, at):
            for headers in ({"origin": "https://example.com"}, {"origin": "null"}):
                with pytest.raises(InvalidStatus) as refused:
                    async with client(at, **headers):
                        pass
                assert refused.value.response.status_code == 403
            async with client(at, origin=f"http://{at}") as socket:
                assert json.loads(await socket.recv())["op"] == "serverInfo"
            # A foreign host name that resolves to this machine: its origin is refused, and it gets no page.
            status, _, _ = await asyncio.to_thread(get, at, "/", Host="example.com:8765")
            assert status == 403
            with pytest.raises(InvalidStatus) as refused:
                async with client(at, subprotocols=None):
                    pass
            assert refused.value.response.status_code == 400
            assert len(audience.viewers) <= 1

    asyncio.run(run())


def test_a_client_that_publishes_is_refused_and_stays_connected():
    async def run() -> None:
        async with served() as (audience, at), client(at) as socket:
            await subscribed(socket, audience)
            await socket.send('{"op":"advertise","channels":[]}')
            await socket.send(b"\x01\x00\x00\x00\x00{}")
            for _ in range(2):
                said = json.loads(await asyncio.wait_for(socket.recv(), PATIENCE_S))
                assert (said["op"], said["level"]) == ("status", 2)
            audience.publish(STATE, 1, b"{}")
            assert isinstance(await asyncio.wait_for(socket.recv(), PATIENCE_S), bytes)

    asyncio.run(run())


def test_a_client_that_does_not_read_delays_no_other():
    async def run() -> None:
        async with (
            served() as (audience, at),
            client(at, max_queue=1) as deaf,
            client(at) as socket,
        ):
            await subscribed(deaf, audience)
            await subscribed(socket, audience)
            payload = bytes(100_000)
            for time_ns in range(400):
                audience.publish(STATE, time_ns, payload)
                frame = await asyncio.wait_for(socket.recv(), PATIENCE_S)
                assert HEADER.unpack_from(frame)[2] == time_ns  # type: ignore[arg-type]
            assert max(viewer.dropped for viewer in audience.viewers) > 100
            deaf.transport.abort()

    asyncio.run(run())


def test_a_client_that_does_not_read_does_not_delay_the_end():
    async def scenario() -> None:
        async with served() as (audience, at):
            stuck = await client(at, max_queue=1)
            await subscribed(stuck, audience)
            stuck.transport.pause_reading()
            for time_ns in range(2000):
                audience.publish(STATE, time_ns, b" " * 10_000)
                await asyncio.sleep(0)
            began = asyncio.get_running_loop().time()
        assert asyncio.get_running_loop().time() - began < 8.0
        stuck.transport.abort()

    asyncio.run(scenario())


def test_too_large_a_request_closes_its_own_connection_only():
    async def run() -> None:
        async with served() as (audience, at), client(at) as socket, client(at) as large:
            await large.send("x" * (server.LARGEST_REQUEST + 1))
            await asyncio.wait_for(large.wait_closed(), PATIENCE_S)
            assert large.close_code == 1009
            await subscribed(socket, audience)

    asyncio.run(run())


def test_the_number_of_viewers_is_limited(monkeypatch: pytest.MonkeyPatch):
    async def run() -> None:
        monkeypatch.setattr(server, "MOST_VIEWERS", 1)
        async with served() as (_, at), client(at) as socket:
            await socket.recv()
            with pytest.raises(InvalidStatus) as refused:
                async with client(at):
                    pass
            assert refused.value.response.status_code == 503

    asyncio.run(run())


def test_the_page_is_one_document_that_loads_nothing():
    async def run() -> None:
        async with served() as (_, at):
            status, headers, content = await asyncio.to_thread(get, at, "/?x=1")
            assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
            policy = headers["Content-Security-Policy"]
            assert policy.startswith("default-src 'none'; script-src 'sha256-")
            assert "connect-src 'self'" in policy
            text = content.decode()
            assert "/* scripts */" not in text
            assert "/* styles */" not in text
            assert text.count("<script") == text.count("</script>") == 1
            assert not any(word in text for word in ("src=", "@import", "url("))
            assert (await asyncio.to_thread(get, at, "/a.json"))[2] == b"{}"
            assert (await asyncio.to_thread(get, at, "/../pyproject.toml"))[0] == 404

    asyncio.run(run())


def test_a_port_that_is_taken_is_an_error_that_names_it():
    async def run() -> None:
        async with served() as (audience, at):
            with pytest.raises(OSError, match="address already in use"):
                async with serving(audience, {}, int(at.partition(":")[2])):
                    pass

    asyncio.run(run())
