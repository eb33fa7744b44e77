"""`tandem live`: serves the bus of one plant to browsers, in a separate process."""

from __future__ import annotations

import asyncio
import errno
import logging
import threading
import time

import msgspec

from lbmpc.plants import Description, get_plant
from node_runtime.bus.mailbox import Mailbox
from node_runtime.bus.zenoh_bus import Bus
from node_runtime.config.plant import plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.lifecycle import new_run_id, run_process
from node_runtime.realtime import clock
from node_runtime.realtime.scheduling import READER_PRIORITY, punctual
from protocol import topics
from protocol.rights import VIEWER
from run_log.views.channel import VIEW
from run_log.views.views import Views
from tandem.web.address import address, taken
from tandem.web.audience import Audience
from tandem.web.layout import layout
from tandem.web.page import page
from tandem.web.server import Document, serving

log = logging.getLogger(__name__)

GATHER_S = 0.02
"""Messages are fetched together, because waking for each one costs more than showing it."""
BREATH = 200
"""Number of messages after which the server's other tasks get a turn."""
VIEW_HZ = 100.0
EVENTS_KEPT = 200
EVENTS, BOUNDS = f"{VIEW}events", f"{VIEW}bounds"


def main(config: Config, stop: threading.Event | None = None) -> int:
    """Serve until told to stop.

    The page is served at once, and also while there is no router or no plant.

    Returns:
        0; 2 when the port is taken, the plant is unknown, or the router refuses the certificate.
    """

    def body(stopping: threading.Event) -> int:
        plant = plant_of(config, get_plant)
        with punctual(min(READER_PRIORITY, config.realtime.priority), silent=True):
            asyncio.run(_serve(config, plant, stopping))
        return 0

    return run_process(body, stop)


async def _serve(config: Config, plant: Description, stopping: threading.Event) -> None:
    facts = {
        "plant": config.name,
        "model": plant.name,
        "oracle": config.controller.oracle,
        "rate": f"{config.rate:g}",
    }
    views = Views(config, plant, most_hz=VIEW_HZ)
    audience = Audience(f"Tandem: {config.name}", new_run_id(VIEWER), facts, _kept)
    for channel in views.channels:
        audience.advertise(channel)
    documents = {
        "/": page(),
        "/layout.json": Document("application/json", msgspec.json.format(msgspec.json.encode(layout(plant)))),
    }
    try:
        async with serving(audience, documents, config.live.port):
            log.info("the page is at http://%s", address(config))
            log.info("for Foxglove and Lichtblick: ws://%s", address(config))
            bus = Bus(config, VIEWER, new_run_id(VIEWER), stopping)
            await asyncio.to_thread(bus.open)
            try:
                await _follow(config, views, audience, bus.everything(), stopping)
            finally:
                bus.close()
    except OSError as error:
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        raise ConfigError(taken(config)) from error


async def _follow(
    config: Config, views: Views, audience: Audience, mailbox: Mailbox, stopping: threading.Event
) -> None:
    prefix = topics.everything(config.name).removesuffix("**")
    # Arrival is stamped on the monotonic clock; one offset for the whole run keeps the times in order.
    to_unix = time.time_ns() - clock.now_ns()
    while not stopping.is_set():
        await asyncio.sleep(GATHER_S)
        for i, delivery in enumerate(mailbox.drain(), 1):
            time_ns = delivery.received_ns + to_unix
            for channel, data in views.show(
                delivery.key.removeprefix(prefix), delivery.payload, time_ns
            ).shown:
                audience.publish(channel, time_ns, data)
            if i % BREATH == 0:
                await asyncio.sleep(0)


def _kept(topic: str) -> int:
    """Return the number of a channel's latest messages that a new viewer gets: those of slow channels."""
    if topic in (EVENTS, BOUNDS):
        return EVENTS_KEPT if topic == EVENTS else 1
    known = topics.BY_NAME.get(topic.removeprefix(VIEW))
    return 1 if known is not None and not known.batched else 0
