"""`tandem report`: pictures and a table of a log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Command, require


@dataclass(frozen=True, kw_only=True)
class Report(Command):
    """Draw a run and tabulate it, from its log alone."""

    EXTRAS = "log"

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The log."""
    output: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the log's)")] = None
    """Where the pictures go."""

    def run(self) -> int:
        """0, or 1 when a picture cannot be drawn or written."""
        import msgspec

        from run_log.reading.reader import read_run
        from run_log.reporting.report import report
        from run_log.reporting.summary import summarise
        from tandem import summary_table

        require("matplotlib")
        ran = read_run(self.file)
        summary = summarise(ran)
        self.console.print(summary_table.table(summary))
        with self.console.status("drawing"):
            drawn, failed = report(self.file, self.output or self.file.parent)
        self.say(*(f"picture {picture}" for picture in drawn))
        if ran.note:
            self.say(ran.note, style="yellow")
        for error in failed:
            terminal.complain(str(error), as_json=False)
        result = {**msgspec.to_builtins(summary), "pictures": [str(picture) for picture in drawn]}
        self.emit({**result, "failed": [str(error) for error in failed]} if failed else result)
        return 1 if failed else 0
