"""The pages that may read the socket. A browser lets every page of the web connect to this machine. Pure."""

from __future__ import annotations

from urllib.parse import urlsplit

LOOPBACK = ("localhost", "127.0.0.1", "::1")
APPS = ("https://app.foxglove.dev",)
"""Viewers on the web that may connect."""
FILE = "file://"
"""Origin of an application that is installed here: the desktop applications of Foxglove and Lichtblick."""


def may_connect(origin: str | None) -> bool:
    """Return whether a client with this `Origin` header may open a socket.

    A program sends none. A browser sends that of the page: only a page that comes from this machine, or from one of
    `APPS`, may connect. "null" is that of a sandboxed frame of any page of the web.
    """
    if origin is None or origin in (*APPS, FILE):
        return True
    try:
        parts = urlsplit(origin)
        return parts.scheme in ("http", "https") and parts.hostname in LOOPBACK
    except ValueError:
        return False


def is_own_name(host: str | None) -> bool:
    """Return whether a `Host` header names this machine as loopback; the port may be that of a tunnel.

    A page whose name was made to resolve to 127.0.0.1 (DNS rebinding) sends that name.
    """
    try:
        return urlsplit(f"//{host or ''}").hostname in LOOPBACK
    except ValueError:
        return False
