"""A small experiment that several test files declare, run or read."""

from __future__ import annotations

from pathlib import Path

from lbmpc.plants import get_plant
from tandem.experiments.study.declaration import Resolved, load, resolve
from tests.helpers.paths import CONFIGS

PLANT = get_plant("moore_greitzer")
SHIPPED = CONFIGS / "experiments" / "paper.toml"
SMALL = """
name = "small"
title = "A small one"
steps = 30
[set]
controller = { horizon = 15, solver = { compile = "never" } }
network = { hidden = [6] }
trainer = { steps = 5 }
[x0s.some]
grid = { z = [0.4, 0.6], y = [1.6] }
[[group]]
name = "comparison"
title = "Comparison"
picture = "trajectories"
reference = "dnn"
[[case]]
name = "linear"
group = "comparison"
set.controller.oracle = "linear"
x0s = "some"
seeds = 2
[[case]]
name = "l2nw"
group = "comparison"
set.controller.oracle = "l2nw"
x0s = "some"
[[case]]
name = "dnn"
group = "comparison"
label = "network"
x0s = "some"
seeds = [3, 4]
[[group]]
name = "rows"
title = "Rows"
picture = "lemma"
[[case]]
name = "gamma"
group = "rows"
vary."adaptation.gamma" = [0.2, 0.5]
log = true
"""


def cases(path: Path, quick: bool = False) -> list[Resolved]:
    return resolve(load(path), PLANT, str(path), quick)
