"""Writes NAME.txt, the requirements of each image, from pyproject.toml: python docker/requirements.py FOLDER.

Requirements are installed before the source is copied, so that a change of the source builds in seconds.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

# The trainer imports nothing of the science; see the contract "The trainer has no CasADi" in pyproject.toml.
NOT_IN_TRAINER = ("casadi", "scipy", "daqp")


def requirements(project: dict) -> dict[str, list[str]]:
    """Requirements by image, from the `[project]` table."""
    base, extras = project["dependencies"], project["optional-dependencies"]
    return {
        "controller": base,
        "recorder": base + extras["log"],
        "worker": base + extras["log"] + extras["trainer"] + extras["cluster"] + own(extras["experiment"]),
        "trainer": [text for text in base if not text.startswith(NOT_IN_TRAINER)] + extras["trainer"],
    }


def own(extra: list[str]) -> list[str]:
    """What an extra names beside other extras of this project."""
    return [text for text in extra if not text.startswith("tandem-control")]


def main() -> None:
    folder = Path(sys.argv[1])
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]
    for image, lines in requirements(project).items():
        (folder / f"{image}.txt").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
