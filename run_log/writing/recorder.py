"""`tandem record`: logs every message on the bus of one plant, in a separate process."""

from __future__ import annotations

import logging
import threading
import time

from lbmpc.plants import get_plant
from node_runtime.bus.zenoh_bus import Bus, Mailbox, OpenInterrupted
from node_runtime.config.plant import files_of, plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.health import HealthPublisher
from node_runtime.lifecycle import new_run_id, stopped_by_signals
from node_runtime.provenance import run_info
from node_runtime.realtime import clock
from node_runtime.realtime.scheduling import READER_PRIORITY, GarbageCollection, punctual
from protocol import topics
from run_log.errors import LogError
from run_log.writing.parts import PartedLog

log = logging.getLogger(__name__)

EXIT_CANNOT = 2
EXIT_NOTHING_WRITTEN = 4
# After Ctrl-C the other processes still send their last messages; receive for that long.
QUIET_S = 0.25
LAST_WORDS_S = 1.5
# Messages are fetched together, because waking for each one costs more than logging it.
GATHER_S = 0.02


def main(config: Config, stop: threading.Event | None = None) -> int:
    """Record to `config.log.path` until told to stop; then finish the file.

    A full or read-only disk does not stop the recorder. It reports the error in Health and tries again until it can
    write.

    Returns:
        0; 2 if the path exists, the plant is unknown or the endpoint is invalid; 4 if nothing could be written.
    """
    with (
        stopped_by_signals(stop) as stopping,
        punctual(min(READER_PRIORITY, config.realtime.priority), silent=True) as punctuality,
    ):
        try:
            plant = plant_of(config, get_plant)
            writer = PartedLog(config, plant, files_of(config), now=clock.now(), start_ns=time.time_ns())
        except (LogError, ConfigError) as error:
            log.error("%s", error)
            return EXIT_CANNOT
        if writer.error is not None:
            log.error("%s; trying again every %d ms", writer.error, config.log.flush_ms)
        run_id = new_run_id("recorder")
        try:
            with Bus(config, "recorder", run_id, stopping) as bus:
                mailbox = bus.everything()
                # After the subscription, so that the log contains the recorder's own messages.
                info = run_info(config, "recorder", run_id, plant.units)
                with HealthPublisher(bus, info, lambda: writer.counters, punctuality) as health:
                    _record(config, writer, mailbox, health, stopping)
        except OpenInterrupted:
            pass
        except ConfigError as error:
            log.error("%s", error)
            _finish(writer)
            return EXIT_CANNOT
        return _finish(writer)


def _record(
    config: Config, writer: PartedLog, mailbox: Mailbox, health: HealthPublisher, stopping: threading.Event
) -> None:
    prefix = topics.everything(config.name).removesuffix("**")
    # Arrival is stamped on the monotonic clock; one offset for the whole run keeps the times in order.
    to_unix = time.time_ns() - clock.now_ns()
    flush_s = config.log.flush_ms * 1e-3
    next_flush = clock.now()
    said: tuple[object, ...] = ()
    end: float | None = None
    last_arrival = clock.now()
    garbage = GarbageCollection()
    garbage.begin()
    while end is None or clock.now() < min(end, last_arrival + QUIET_S):
        if end is None and stopping.is_set():
            last_arrival = clock.now()
            end = last_arrival + LAST_WORDS_S
        clock.sleep_until(clock.now() + GATHER_S)
        for delivery in mailbox.drain():
            last_arrival = clock.now()
            name, log_time = delivery.key.removeprefix(prefix), delivery.received_ns + to_unix
            writer.write(name, delivery.payload, log_time, last_arrival)
        garbage.idle()
        if clock.now() >= next_flush:
            writer.flush(clock.now(), clock.now_ns() + to_unix)
            next_flush = clock.now() + flush_s
            if (now := (writer.path, writer.error, bool(writer.lost))) != said:
                said = now
                _say(writer, health)


def _say(writer: PartedLog, health: HealthPublisher) -> None:
    error = writer.error
    note = f"writing {writer.path}"
    if error is None:
        log.info("%s", note)
    else:
        log.error("%s; trying again, %d messages dropped so far", error, writer.counters["dropped"])
        note = f"NOT LOGGED: {error}"
    if writer.lost:
        log.error(
            "ticks of the controller did not reach the recorder; the log has gaps, and replay lists them"
        )
        note += "; THE LOG HAS GAPS: messages were lost, see the counter 'lost ticks'"
    health.set("running", note)


def _finish(writer: PartedLog) -> int:
    if writer.last_bad is not None:
        log.warning("logged without a view: %s; the last one: %s", writer.bad, writer.last_bad)
    if writer.lost:
        log.error(
            "%s: %d ticks did not reach the recorder and are missing",
            writer.path,
            writer.counters["lost_ticks"],
        )
    try:
        writer.close()
    except LogError as error:
        log.error("%s", error)
    if writer.counters["file_bytes"] == 0:
        return EXIT_NOTHING_WRITTEN
    log.info("%s: %d messages", writer.path, writer.counters["messages"])
    return 0
