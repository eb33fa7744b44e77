"""The rich console of all commands; it prints text from any source safely."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from node_runtime.printable import printable


class PlainConsole(Console):
    """No markup, no emoji names, no highlighting; and no control characters but its own."""

    def __init__(self, stderr: bool = False):
        super().__init__(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """As in rich. Every text passes here before its layout, also texts within tables and panels."""
        if isinstance(renderable, str):
            renderable = self.render_str(renderable)
        if isinstance(renderable, Text) and (plain := printable(renderable.plain)) != renderable.plain:
            styles = {"style": renderable.style, "justify": renderable.justify}
            whole = {"overflow": renderable.overflow, "no_wrap": renderable.no_wrap, "end": renderable.end}
            renderable = Text(plain, **styles, **whole)  # type: ignore[arg-type]
        return super().render(renderable, options)
