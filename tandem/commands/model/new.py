"""`tandem model new`: a plant file to start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem.commands.base import Command


@dataclass(frozen=True, kw_only=True)
class ModelNew(Command):
    """Write a plant file to start from, with comments; it runs without changes."""

    file: Annotated[Positional[Path], arg(metavar="FILE.py")]
    """Name of the new file."""

    def run(self) -> int:
        from importlib.resources import files

        from tandem.plant_file import write_new

        text = files("tandem.templates").joinpath("plant.py").read_text(encoding="utf-8")
        name = str(self.file)
        # Not one that would end a string of Python.
        plain = name.isprintable() and '"' not in name and "\\" not in name
        write_new(self.file, text.replace("THIS_FILE", name if plain else "FILE.py"))
        self.say(
            f"{self.file}: PLANT has equations and MATRICES has matrices; keep one of them",
            f"check it:   tandem model check {self.file}:PLANT",
            f"run it:     tandem run --set plant.model={self.file}:PLANT",
        )
        self.emit({"file": str(self.file), "names": ["PLANT", "MATRICES"]})
        return 0
