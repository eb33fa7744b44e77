"""Display of a live run: a full view on a terminal, one line a second elsewhere."""

from __future__ import annotations

from collections.abc import Callable

from rich.console import Console
from rich.live import Live

from tandem.live import view
from tandem.live.snapshot import Event, Snapshot
from tandem.streams import blocked
from tandem.terminal import say


class Screen:
    """A context manager; `show` may be called at any rate."""

    def __init__(self, console: Console, new_events: Callable[[], list[Event]]):
        self._console = console
        self._new_events = new_events
        self._second: int | None = None
        self._live = Live(console=console, auto_refresh=False, vertical_overflow="crop")

    def show(self, now: Snapshot) -> None:
        """Update the screen; skip it if the terminal does not accept output, so that no loop waits."""
        if blocked(self._console.file):
            return
        if self._console.is_terminal:
            width, height = self._console.size
            self._live.update(view.render(now, width, height - 1), refresh=True)
            return
        for event in self._new_events():
            at = "          " if event.at < 0 else f"{event.at:6.1f} s  "
            self._plain(f"{at}{event.text}")
        second = int(now.elapsed) if now.elapsed is not None else None
        if second is not None and second != self._second:
            self._second = second
            self._plain(view.line(now))

    def _plain(self, text: str) -> None:
        # A text of another process with several lines must not imitate a line of this program.
        say(self._console, text.replace("\n", "\n" + 10 * " "))

    def __enter__(self) -> Screen:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._live.stop()
