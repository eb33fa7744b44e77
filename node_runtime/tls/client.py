"""A client's way in by TLS: its own certificate, checked first, and why the router does not open."""

from __future__ import annotations

import logging
import threading
from typing import Any

from node_runtime.config.sections import Config
from node_runtime.tls import credentials
from node_runtime.tls.access_control import client_settings
from node_runtime.tls.handshake import knock
from protocol.rights import role_of

log = logging.getLogger(__name__)

# Zenoh opens a link that is welcome within some ten milliseconds.
FIRST_KNOCK_S = 0.5
NEXT_KNOCK_S = 3.0
LOOK_AGAIN_S = 3600.0
"""Seconds between two looks at the clock, which may be set meanwhile."""


class Door:
    """One process before a router that wants certificates.

    Raises:
        ConfigError: the process's certificate cannot be used, and why.
    """

    def __init__(self, config: Config, process: str):
        self._endpoint = config.bus.endpoint
        self._credentials = credentials.of_process(config.bus.tls.keys, role_of(process), config.name)
        self._reason: str | None = None
        self._knocking: threading.Thread | None = None
        self._next = FIRST_KNOCK_S
        left = self._credentials.days_left()
        if left < credentials.WARN_DAYS:
            log.warning(
                "%s expires in %.0f days, and its links end then: `tandem keys renew --role %s`",
                self._credentials.certificate,
                left,
                self._credentials.role,
            )

    @property
    def settings(self) -> dict[str, Any]:
        """For Zenoh's configuration."""
        return client_settings(self._credentials)

    def refused(self, waited_s: float) -> str | None:
        """Why the router and we refuse each other, once that is known; asked again and again while we wait."""
        if self._endpoint.startswith("tls/") and waited_s >= self._next:
            self._next = waited_s + NEXT_KNOCK_S
            if self._knocking is None or not self._knocking.is_alive():
                self._knocking = threading.Thread(target=self._knock, name="knock", daemon=True)
                self._knocking.start()
        return self._reason

    def watch(self, stop: threading.Event) -> None:
        """Say it in the log when the certificate is over: the links end then, and Zenoh says nothing."""

        def look() -> None:
            while (reason := self._credentials.expired()) is None:
                # A little later than that moment, so that it is over in any case.
                left_s = self._credentials.days_left() * 86400.0
                if stop.wait(min(LOOK_AGAIN_S, left_s + 0.1)):
                    return
            log.error("%s; our links to %s end now. Start again with the new one", reason, self._endpoint)

        threading.Thread(target=look, name="certificate", daemon=True).start()

    def _knock(self) -> None:
        self._reason = self._credentials.expired() or knock(self._endpoint, self._credentials)
