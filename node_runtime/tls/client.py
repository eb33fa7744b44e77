"""A client's TLS link: its certificate, checked first, and the reason if client and router refuse each other.

Zenoh's client retries a refused link without end and does not report the reason. A separate TLS handshake finds the
reason.
"""

from __future__ import annotations

import logging
import socket
import ssl
import threading
from typing import Any
from urllib.parse import urlsplit

from node_runtime.config.sections import Config
from node_runtime.tls import credentials
from node_runtime.tls.access_control import client_settings
from node_runtime.tls.credentials import Credentials
from protocol.rights import role_of

log = logging.getLogger(__name__)

# Zenoh opens an accepted link within about ten milliseconds.
FIRST_HANDSHAKE_S = 0.5
NEXT_HANDSHAKE_S = 3.0
TIMEOUT_S = 2.0
# In TLS 1.3 the client finishes before the server checks its certificate.
VERDICT_S = 0.5
CLOCK_CHECK_S = 3600.0
"""Seconds between two checks of the clock, which may be set meanwhile."""

_ALERTS = {
    "UNKNOWN_CA": "it does not know the authority of our certificate: {folder} is from another authority",
    "CERTIFICATE_EXPIRED": "our certificate has expired by its clock",
    "CERTIFICATE_REQUIRED": "it requires a certificate and received none",
    "BAD_CERTIFICATE": "it considers our certificate malformed",
    "CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "DECRYPT_ERROR": "our certificate is from another authority of the same name",
}
# Values of OpenSSL's X509_V_ERR_*.
_EXPIRED, _NOT_YET = 10, 9
_HOSTNAME, _ADDRESS = 62, 64


class TlsClient:
    """One process that connects to a router with a certificate.

    Raises:
        ConfigError: the process's certificate cannot be used. The text says why.
    """

    def __init__(self, config: Config, process: str):
        self._endpoint = config.bus.endpoint
        self._credentials = credentials.of_process(config.bus.tls.keys, role_of(process), config.name)
        self._reason: str | None = None
        self._trying: threading.Thread | None = None
        self._next = FIRST_HANDSHAKE_S
        left = self._credentials.days_left()
        if left < credentials.WARN_DAYS:
            log.warning(
                "%s expires in %.0f days, and its links will be closed then: renew it by `tandem keys renew --role %s`",
                self._credentials.certificate,
                left,
                self._credentials.role,
            )

    @property
    def settings(self) -> dict[str, Any]:
        """Settings for Zenoh's configuration."""
        return client_settings(self._credentials)

    def refused(self, waited_s: float) -> str | None:
        """Return why router and client refuse each other, once it is known. Call it repeatedly while waiting."""
        if self._endpoint.startswith("tls/") and waited_s >= self._next:
            self._next = waited_s + NEXT_HANDSHAKE_S
            if self._trying is None or not self._trying.is_alive():
                self._trying = threading.Thread(target=self._try, name="handshake", daemon=True)
                self._trying.start()
        return self._reason

    def watch(self, stop: threading.Event) -> None:
        """Log the expiry of the certificate, because Zenoh closes the links then without a message."""

        def look() -> None:
            while (reason := self._credentials.expired()) is None:
                # Wait slightly longer, so that the certificate certainly has expired.
                left_s = self._credentials.days_left() * 86400.0
                if stop.wait(min(CLOCK_CHECK_S, left_s + 0.1)):
                    return
            log.error(
                "%s; the links to %s are closed now. Restart with a new certificate", reason, self._endpoint
            )

        threading.Thread(target=look, name="certificate", daemon=True).start()

    def _try(self) -> None:
        self._reason = self._credentials.expired() or refusal(self._endpoint, self._credentials)


def refusal(endpoint: str, own: Credentials) -> str | None:
    """Find by a TLS handshake why the router at `tls/HOST:PORT` and this client refuse each other.

    The result is None if they do not, or if there is no answer.
    """
    place = urlsplit(f"tls://{endpoint.partition('/')[2]}")
    host, port = place.hostname, place.port
    if host is None or port is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(own.authority)
        context.load_cert_chain(own.certificate, own.key)
        with (
            socket.create_connection((host, port), TIMEOUT_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as link,
        ):
            link.settimeout(VERDICT_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _refused_by_us(error, host, own)
    except ssl.SSLError as error:
        return _refused_by_router(error.reason or str(error), own)
    except OSError:  # no router, or no answer in time: not a refusal
        return None
    return None


def _refused_by_us(error: ssl.SSLCertVerificationError, host: str, own: Credentials) -> str:
    if error.verify_code in (_EXPIRED, _NOT_YET):
        return "the router's certificate has expired or is not valid yet: `tandem keys renew --role router`"
    if error.verify_code in (_HOSTNAME, _ADDRESS):
        return (
            f"the router's certificate is not for {host}: "
            f"`tandem keys renew --role router --host {host}`, then start the router again"
        )
    return (
        f"the router's certificate does not come from the authority in {own.authority} "
        f"({error.verify_message}): it is another router, or its keys were replaced"
    )


def _refused_by_router(reason: str, own: Credentials) -> str:
    for alert, text in _ALERTS.items():
        if alert in reason:
            return f"the router refused us: {text.format(folder=own.folder)} ({reason})"
    if reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNEXPECTED_EOF_WHILE_READING"):
        return f"the other side does not use TLS ({reason}): is it the router's plain endpoint?"
    return f"the router refused us: {reason}"
