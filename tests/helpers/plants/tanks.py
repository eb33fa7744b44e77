"""A user's plant file, as text: two tanks, from docs/tutorials/your-plant.md, and a simulator for one of them."""

from __future__ import annotations

from pathlib import Path

from tests.helpers.paths import DOCS

SETTINGS = [
    *("plant.model=tanks.py:TANKS", "rate=1", "controller.horizon=10", "controller.oracle=linear"),
    "controller.solver.compile=never",
]
OPTIONS = [word for setting in SETTINGS for word in ("--set", setting)]
TRUE = """
import numpy as np


class Leaking:
    def step(self, x, u, dt):
        for _ in range(20):
            upper, lower = np.sqrt(x)
            x = x + dt / 20 * np.array([u[0] - 0.11 * upper, 0.1 * upper - 0.1 * lower])
        return x


LEAKING = Leaking()
"""


def write_tanks(folder: Path) -> Path:
    """tanks.py, as the page of the documentation has it."""
    page = (DOCS / "tutorials/your-plant.md").read_text(encoding="utf-8")
    _, _, rest = page.partition("```python\n# tanks.py\n")
    file = folder / "tanks.py"
    file.write_text(rest.partition("```")[0], encoding="utf-8")
    return file
