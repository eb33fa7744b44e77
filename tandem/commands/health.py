"""`tandem health`: state of a process, as it reports itself on the bus. Light enough to run every few seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, get_args

from tyro.conf import Positional, arg

from node_runtime.config.literals import ProcessName
from tandem import terminal
from tandem.commands.base import Configured

if TYPE_CHECKING:
    from node_runtime.config.sections import Config
    from protocol import messages

WELL = ("ready", "running")


@dataclass(frozen=True, kw_only=True)
class Health(Configured):
    """Ask the bus for the state of a process: exit code 0 if it is ready or running, else 1. For health checks."""

    process: Annotated[Positional[ProcessName], arg(metavar="|".join(get_args(ProcessName)))]
    """Which process."""
    seconds: Annotated[float, arg(metavar="S")] = 3.0
    """How long to listen; a process reports twice a second."""

    def run(self) -> int:
        config, _ = self.resolve()
        terminal.limited("--seconds", self.seconds, 0.0, 86_400.0)
        return answer(config, self.process, self.seconds, self.json)


def answer(config: Config, process: str, seconds: float, as_json: bool) -> int:
    """Print the state of the process; return 0 if it is ready or running, 1 if it is not or does not report."""
    health = ask(config, process, seconds)
    if health is None:
        text = f"{process}: no message for {seconds:g} s at {config.bus.endpoint}"
        if not as_json:
            terminal.write(text + "\n")
        else:
            terminal.emit({"process": process, "status": None, "error": text})
        return 1
    if as_json:
        fields = ("process", "run_id", "status", "note", "counters")
        terminal.emit({name: getattr(health, name) for name in fields})
    else:
        terminal.write(": ".join(filter(None, (process, health.status, health.note))) + "\n")
    return 0 if health.status in WELL else 1


def ask(config: Config, process: str, seconds: float) -> messages.Health | None:
    """Return the next `Health` of a process; None if there is none for `seconds`, or no router answers.

    Raises:
        ConfigError: the endpoint is none.
    """
    import threading

    from node_runtime.bus.zenoh_bus import Bus, OpenInterrupted
    from node_runtime.lifecycle import new_run_id
    from node_runtime.realtime import clock
    from protocol import codec, messages, topics

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
                if isinstance(message, messages.Health):
                    return message
    except OpenInterrupted:
        pass
    finally:
        timer.cancel()
    return None
