"""The server of `tandem live`: the page and the socket, on one port of this machine."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from http import HTTPStatus
from typing import NamedTuple

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from tandem.web.address import HOST
from tandem.web.audience import Audience, Viewer
from tandem.web.foxglove_protocol import SUBPROTOCOLS
from tandem.web.origins import is_own_name, may_connect

log = logging.getLogger(__name__)

MOST_VIEWERS = 32
MOST_NAMED = 20
"""Origins that are named in the log when they are refused."""
LARGEST_REQUEST = 256 * 1024
"""Bytes of one request of a viewer: it names channels."""


class Document(NamedTuple):
    """A document that is served at one path."""

    kind: str
    """Its media type."""
    content: bytes
    policy: str = "default-src 'none'"
    """Its Content-Security-Policy."""


@asynccontextmanager
async def serving(audience: Audience, documents: Mapping[str, Document], port: int) -> AsyncIterator[int]:
    """Serve on loopback until the block ends; yields the port.

    Args:
        audience: the viewers and the channels.
        documents: by path, as "/".
        port: 0 takes any.

    Raises:
        OSError: the port is taken, or not permitted.
    """

    async def watch(connection: ServerConnection) -> None:
        viewer = audience.enter()
        sending = asyncio.create_task(_send(connection, viewer))
        try:
            async for text in connection:
                audience.obey(viewer, text)
        except ConnectionClosed:
            pass
        finally:
            audience.leave(viewer)
            sending.cancel()
            if viewer.dropped:
                log.info("a viewer was too slow: %d messages were not sent to it", viewer.dropped)

    refused: set[str] = set()

    def answer(_connection: ServerConnection, request: Request) -> Response | None:
        for origin in request.headers.get_all("Origin"):
            # Each once: a page may ask all the time.
            if not may_connect(origin) and origin not in refused and len(refused) < MOST_NAMED:
                refused.add(origin)
                log.warning("a page of %s may not connect", origin[:200])
        return respond(request, documents, len(audience.viewers))

    async with serve(
        watch,
        HOST,
        port,
        process_request=answer,
        subprotocols=[Subprotocol(name) for name in SUBPROTOCOLS],
        # The link is this machine's, or a tunnel that compresses by itself if it should.
        compression=None,
        max_size=LARGEST_REQUEST,
        server_header=None,
        # Broken handshakes are no events of the system.
        logger=_quiet(),
    ) as server:
        yield next(iter(server.sockets)).getsockname()[1]


async def _send(connection: ServerConnection, viewer: Viewer) -> None:
    with suppress(ConnectionClosed):
        while True:
            await connection.send(await viewer.next_frame())


def respond(request: Request, documents: Mapping[str, Document], viewers: int) -> Response | None:
    """Return the answer to a request over HTTP; None: the request may become a socket."""
    headers = request.headers
    if not is_own_name(_only(headers, "Host")):
        return _said(
            HTTPStatus.FORBIDDEN, "this server accepts only localhost; from another machine use ssh -L"
        )
    if "websocket" in headers.get("Upgrade", "").lower():
        if not all(may_connect(origin) for origin in headers.get_all("Origin")):
            return _said(HTTPStatus.FORBIDDEN, "pages of this origin may not connect")
        if viewers >= MOST_VIEWERS:
            return _said(
                HTTPStatus.SERVICE_UNAVAILABLE, f"{viewers} viewers are connected already, which is the limit"
            )
        return None
    document = documents.get(request.path.partition("?")[0])
    if document is None:
        return _said(HTTPStatus.NOT_FOUND, "no document at this path; the page is at /")
    return _response(HTTPStatus.OK, document)


def _only(headers: Headers, name: str) -> str | None:
    """Return the value of a header; None if it is missing or given twice."""
    values = headers.get_all(name)
    return values[0] if len(values) == 1 else None


def _said(status: HTTPStatus, text: str) -> Response:
    return _response(status, Document("text/plain; charset=utf-8", f"{text}\n".encode()))


def _response(status: HTTPStatus, document: Document) -> Response:
    headers = Headers(
        {
            "Content-Type": document.kind,
            "Content-Length": str(len(document.content)),
            "Content-Security-Policy": f"{document.policy}; frame-ancestors 'none'",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, document.content)


def _quiet() -> logging.Logger:
    logger = logging.getLogger("tandem.web.connections")
    logger.setLevel(logging.CRITICAL)
    return logger
