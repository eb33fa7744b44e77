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
    """Plot and tabulate a run, from its log alone."""

    EXTRAS = "log"

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The log."""
    output: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: the log's)")] = None
    """Folder for the pictures."""

    plant: Annotated[
        str | None, arg(metavar="FILE:NAME", help_behavior_hint="(default: the log's numbers)")
    ] = None
    """The plant file with the true equations of that run. Without it the report omits the motion between samples."""

    def run(self) -> int:
        """Return 0, or 1 if a picture cannot be drawn or written."""
        import msgspec

        from run_log.named_plant import name_truth
        from run_log.reading.reader import read_run
        from run_log.reporting.report import report
        from run_log.reporting.summary import summarise
        from run_log.run import true_plant_of
        from tandem import summary_table

        require("matplotlib")
        ran = read_run(self.file)
        notes = [] if self.plant is None else name_truth(ran, self.plant)
        summary = summarise(ran)
        self.console.print(summary_table.table(summary))
        with self.console.status("drawing"):
            drawn, failed = report(ran, self.output or self.file.parent)
        self.say(*(f"picture {picture}" for picture in drawn))
        if true_plant_of(ran) is None:
            notes.append(
                "the motion between samples is unknown: the log has no equations; add --plant FILE:NAME"
            )
        self.say(*filter(None, (ran.note, *(f"note: {note}" for note in notes))), style="yellow")
        for error in failed:
            terminal.complain(str(error), as_json=False)
        result = {**msgspec.to_builtins(summary), "pictures": [str(picture) for picture in drawn]}
        self.emit({**result, "failed": [str(error) for error in failed]} if failed else result)
        return 1 if failed else 0
