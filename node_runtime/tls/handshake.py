"""Why a router does not let us in: a TLS handshake of our own, whose end says it.

Zenoh's client tries a refused link again for ever and keeps the reason to itself.
"""

from __future__ import annotations

import socket
import ssl
from urllib.parse import urlsplit

from node_runtime.tls.credentials import Credentials

TIMEOUT_S = 2.0
# In TLS 1.3 the client has finished before the server looks at its certificate.
VERDICT_S = 0.5

_ALERTS = {
    "UNKNOWN_CA": "it does not know the authority of our certificate: {folder} was made by another authority",
    "CERTIFICATE_EXPIRED": "our certificate has expired by its clock",
    "CERTIFICATE_REQUIRED": "it wants a certificate and got none",
    "BAD_CERTIFICATE": "it takes our certificate for malformed",
    "CERTIFICATE_UNKNOWN": "it does not accept our certificate",
    "DECRYPT_ERROR": "our certificate was made by another authority of the same name",
}
# Of OpenSSL's X509_V_ERR_*.
_EXPIRED, _NOT_YET = 10, 9
_HOSTNAME, _ADDRESS = 62, 64


def knock(endpoint: str, credentials: Credentials) -> str | None:
    """Why the router at `tls/HOST:PORT` and we refuse each other; None when we do not, or nobody is there."""
    place = urlsplit(f"tls://{endpoint.partition('/')[2]}")
    host, port = place.hostname, place.port
    if host is None or port is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(credentials.authority)
        context.load_cert_chain(credentials.certificate, credentials.key)
        with (
            socket.create_connection((host, port), TIMEOUT_S) as plain,
            context.wrap_socket(plain, server_hostname=host) as link,
        ):
            link.settimeout(VERDICT_S)
            link.recv(1)
    except ssl.SSLCertVerificationError as error:
        return _router_refused(error, host, credentials)
    except ssl.SSLError as error:
        return _refused_by_router(error, credentials)
    except OSError:  # nobody there, or nothing said within the time: no refusal
        return None
    return None


def _router_refused(error: ssl.SSLCertVerificationError, host: str, credentials: Credentials) -> str:
    if error.verify_code in (_EXPIRED, _NOT_YET):
        return "the router's certificate has expired or is not valid yet: `tandem keys renew --role router`"
    if error.verify_code in (_HOSTNAME, _ADDRESS):
        return (
            f"the router's certificate is not for {host}: "
            f"`tandem keys renew --role router --host {host}`, then start the router again"
        )
    return (
        f"the router's certificate does not come from the authority in {credentials.authority} "
        f"({error.verify_message}): it is another router, or its keys were made anew"
    )


def _refused_by_router(error: ssl.SSLError, credentials: Credentials) -> str:
    reason = error.reason or str(error)
    for alert, text in _ALERTS.items():
        if alert in reason:
            return f"the router refused us: {text.format(folder=credentials.folder)} ({reason})"
    if reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "UNEXPECTED_EOF_WHILE_READING"):
        return f"what listens there does not speak TLS ({reason}): is it the router's plain endpoint?"
    return f"the router refused us: {reason}"
