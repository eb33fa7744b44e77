"""`tandem export`: a log for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Command, require

NONE = "(default: none)"


@dataclass(frozen=True, kw_only=True)
class Export(Command):
    """Write a log as tables (CSV, Parquet) or as a Rerun recording."""

    EXTRAS = "export"

    file: Annotated[Positional[Path], arg(metavar="LOG")]
    """The log; for a log in parts the first one, from which the others are found."""
    csv: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint=NONE)] = None
    """A new or empty folder for CSV files, one per table."""
    parquet: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint=NONE)] = None
    """A new or empty folder for Parquet files, one per table."""
    rrd: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=NONE)] = None
    """A new file for Rerun: series, events and a layout."""

    def run(self) -> int:
        """Return 0, or 1 if a part of the log is damaged and missing in the export."""
        import msgspec

        if self.csv is None and self.parquet is None and self.rrd is None:
            raise terminal.Refused("name what to write: --csv FOLDER, --parquet FOLDER or --rrd FILE")
        require("mcap", *(["pyarrow"] if self.parquet else []), *(["rerun"] if self.rrd else []))
        from run_log.exporting.export import export

        with self.console.status("exporting"):
            made = export(self.file, csv=self.csv, parquet=self.parquet, rrd=self.rrd)
        rows = sum(made.tables.values())
        parts = f" from {len(made.log)} parts" if len(made.log) > 1 else ""
        written = [str(path) for path in (self.csv, self.parquet, self.rrd) if path is not None]
        self.say(f"{' and '.join(written)}: {len(made.tables)} tables, {rows} rows{parts}")
        not_exported = {
            **made.bad,
            **{f"unknown topic {key}": count for key, count in made.strangers.items()},
        }
        notes = [*made.notes, *(f"without a row: {count} x {what}" for what, count in not_exported.items())]
        self.say(*(f"note: {note}" for note in notes), style="yellow")
        self.say(*made.damage, style="red")
        self.emit(msgspec.to_builtins(made))
        return 1 if made.damage else 0
