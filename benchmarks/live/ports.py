"""Free ports of this machine for runs that must not collide."""

from __future__ import annotations

import socket


def free_port() -> int:
    """Return a port on loopback that is free at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
