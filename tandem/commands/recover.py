"""`tandem recover`: repair a log that was cut off."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem.commands.base import Command


@dataclass(frozen=True, kw_only=True)
class Recover(Command):
    """Write a complete copy of a log whose recorder did not end cleanly."""

    EXTRAS = "log"

    file: Annotated[Positional[Path], arg(metavar="FILE")]
    """The log; it does not change."""
    output: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: NAME.recovered.mcap)")
    ] = None
    """File of the complete log."""

    def run(self) -> int:
        import msgspec

        from run_log.reading.recover import recover

        file = self.file
        saved = recover(file, self.output or file.with_suffix(f".recovered{file.suffix or '.mcap'}"))
        if saved.log is None:
            text = f"{file} is complete: {saved.messages} messages over {saved.seconds:.1f} s; nothing to do"
        else:
            text = f"{saved.log}: {saved.messages} messages over {saved.seconds:.1f} s saved from {file}"
            if saved.cut_at is not None:
                lost = f"{saved.lost_bytes} bytes of an incomplete record are lost"
                text += f", which was cut at byte {saved.cut_at} ({lost})"
        self.say(text, *saved.damage)
        self.emit(msgspec.to_builtins(saved))
        return 0
