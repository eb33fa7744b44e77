"""`tandem health`: how a process is, as it says itself on the bus. Light enough to run every few seconds."""

from __future__ import annotations

import sys
import threading

from node_runtime.bus.zenoh_bus import Bus, OpenInterrupted
from node_runtime.config.sections import Config
from node_runtime.lifecycle import new_run_id
from node_runtime.realtime import clock
from protocol import codec, topics
from protocol.messages import Health
from tandem import terminal

WELL = ("ready", "running")


def ask(config: Config, process: str, seconds: float) -> Health | None:
    """The next `Health` of a process; None when it says nothing for `seconds`, or no router answers.

    Raises:
        ConfigError: the endpoint is none.
    """
    topic = topics.HEALTH[process]
    deadline = clock.now() + seconds
    stop = threading.Event()
    timer = threading.Timer(seconds, stop.set)
    timer.daemon = True
    timer.start()
    try:
        with Bus(config, "monitor", new_run_id("monitor"), stop) as bus:
            heard = bus.queue(topic)
            while (left := deadline - clock.now()) > 0.0:
                delivery = heard.get(left)
                if delivery is None:
                    return None
                try:
                    message = codec.decode(topic, delivery.payload)
                except codec.BadMessage:
                    continue
                if isinstance(message, Health):
                    return message
    except OpenInterrupted:
        pass
    finally:
        timer.cancel()
    return None


def run(config: Config, process: str, seconds: float, as_json: bool) -> int:
    """Say how the process is; 0 when it is ready or running, 1 when it is not or says nothing."""
    health = ask(config, process, seconds)
    if health is None:
        text = f"{process}: not heard of for {seconds:g} s at {config.bus.endpoint}"
        if not as_json:
            sys.stdout.write(text + "\n")
        else:
            terminal.emit({"process": process, "status": None, "error": text})
        return 1
    if as_json:
        fields = ("process", "run_id", "status", "note", "counters")
        terminal.emit({name: getattr(health, name) for name in fields})
    else:
        sys.stdout.write(": ".join(filter(None, (process, health.status, health.note))) + "\n")
    return 0 if health.status in WELL else 1
