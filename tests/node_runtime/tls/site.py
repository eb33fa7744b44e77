"""A router with a local endpoint and one with certificates, and clients for it."""

from __future__ import annotations

import threading
from pathlib import Path

import zenoh

from node_runtime.bus.session import session_config
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.tls import access_control, credentials
from tests.helpers.live import HANG_S, Process


class Listener:
    """Collects the standard error of a process."""

    def __init__(self, process: Process):
        self._text = ""
        self._changed = threading.Condition()
        threading.Thread(target=self._read, args=(process,), daemon=True).start()

    def _read(self, process: Process) -> None:
        for line in process.lines():
            with self._changed:
                self._text += line
                self._changed.notify_all()

    def heard(self, words: str, timeout_s: float = HANG_S) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: words in self._text, timeout_s), (
                f"no {words!r} in {self._text}"
            )


class Site:
    """A router with a local endpoint and one with certificates, and keys of two authorities."""

    def __init__(self, folder: Path, router: Process, config: Config):
        self.folder, self.router, self.local = folder, Listener(router), config
        assert config.bus.remote is not None
        self.remote = config.bus.remote

    def far(self, role: str, authority: str = "jet1", *more: str) -> Config:
        """Return the configuration of a process on another machine."""
        keys = self.folder / authority / role
        return override(
            self.local, [f'bus.endpoint="{self.remote}"', f'bus.tls.keys="{keys}"', 'bus.remote=""', *more]
        )

    def session(self, role: str, authority: str = "jet1") -> zenoh.Session:
        """Open a session with that role's certificate and none of our checks, as a hostile program would."""
        own = credentials.read(self.folder / authority / role)
        return zenoh.open(
            session_config("client", self.remote, 5000, more=access_control.client_settings(own))
        )
