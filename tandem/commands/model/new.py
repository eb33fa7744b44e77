"""`tandem model new`: a plant file to start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem.commands.base import Command
from tandem.terminal import Refused


@dataclass(frozen=True, kw_only=True)
class ModelNew(Command):
    """Write a plant file to start from, with comments; it runs as it is."""

    file: Annotated[Positional[Path], arg(metavar="FILE.py")]
    """Its name."""

    def run(self) -> int:
        from importlib.resources import files

        require_new(self.file)
        text = files("tandem.templates").joinpath("plant.py").read_text(encoding="utf-8")
        self.file.write_text(text.replace("THIS_FILE", str(self.file)), encoding="utf-8")
        self.say(
            f"{self.file}: PLANT by its equations, and MATRICES by numbers; keep one",
            f"look at it: tandem model check {self.file}:PLANT",
            f"run it:     tandem run --set plant.model={self.file}:PLANT",
        )
        self.emit({"file": str(self.file), "names": ["PLANT", "MATRICES"]})
        return 0


def require_new(file: Path) -> None:
    """Raises `Refused` for a plant file that cannot be written there."""
    if file.suffix != ".py":
        raise Refused(f"{file}: the name of a plant file ends in .py")
    if file.exists():
        raise Refused(f"{file}: exists already, and is not overwritten; choose another name")
    if not file.absolute().parent.is_dir():
        raise Refused(f"{file}: there is no folder {file.absolute().parent}")
