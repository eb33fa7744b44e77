"""`tandem router`: the Zenoh router that all nodes are clients of."""

from __future__ import annotations

import logging
import threading

import zenoh

from node_runtime.bus import Bus, OpenInterrupted
from node_runtime.config import Config, ConfigError
from node_runtime.health import HealthPublisher, run_info
from node_runtime.lifecycle import new_run_id, stopped_by_signals
from node_runtime.realtime import punctual
from node_runtime.session import lease_ms, session_config

log = logging.getLogger(__name__)


class RouterError(RuntimeError):
    """The router cannot listen; the text says where and what to do."""


class Router:
    """A Zenoh session in router mode, listening on `config.bus.endpoint`. A context manager."""

    def __init__(self, config: Config):
        self.config = config
        self.run_id = new_run_id("router")
        self._session: zenoh.Session | None = None

    def open(self) -> None:
        """Listen. Raises `RouterError` when that is not possible, `ConfigError` when the endpoint is none."""
        bus = self.config.bus
        try:
            self._session = zenoh.open(
                session_config("router", bus.endpoint, lease_ms(self.config, "router"))
            )
        except zenoh.ZError as error:
            if "in use" in str(error):
                raise RouterError(
                    f"{bus.endpoint} is taken: another router may be running. "
                    "Stop it, or set bus.endpoint to another port."
                ) from error
            raise RouterError(f"the router cannot listen on {bus.endpoint}: {error}") from error

    def close(self) -> None:
        if self._session is not None:
            self._session.close()
            self._session = None

    def __enter__(self) -> Router:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def main(config: Config, stop: threading.Event | None = None) -> int:
    """`tandem router`: route until told to stop. 0; 1 when the endpoint is taken; 2 when it is none."""
    # Every state and every command passes through here, so the router must be as punctual as the loops.
    with (
        stopped_by_signals(stop) as stopping,
        punctual(config.realtime.priority, keep_awake=config.awake) as note,
    ):
        try:
            with Router(config) as router:
                log.info("router listening on %s", config.bus.endpoint)
                # Its health travels like everybody else's, through a client of itself.
                with (
                    Bus(config, "router", router.run_id, stopping) as bus,
                    HealthPublisher(bus, run_info(config, "router", router.run_id), note=note) as health,
                ):
                    health.set("running")
                    stopping.wait()
        except RouterError as error:
            log.error("%s", error)
            return 1
        except ConfigError as error:
            log.error("%s", error)
            return 2
        except OpenInterrupted:
            pass
    return 0
