"""The true plant after its controller falls silent: `python -m verification.outage`, decision 0025.

Lock-step runs from the paper's x0, in which commands act some time after their samples. After each tick of the first
four seconds the controller is silenced permanently. The plant continues for three seconds, the length of a plan, and
for six, with the rest of the plan or with the backup policy, and after their end with a constant safe input or one
with feedback.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import tyro
from rich.console import Console

from benchmarks.document_block import Marks
from controller_node.build import build_plant
from controller_node.core import ControllerCore
from lbmpc.plants import Description, PlantError, true_motion
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from plant_sim.simulator import PlantSim
from protocol import messages as m
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import CONTROLLER, PLANT, follow

STEPS = 80
SHORT, LONG = 3.0, 6.0
DELAYS = (0.002, 0.010)
"""Seconds from a sample until its command acts."""
MARGINS = (0.0, 0.005, 0.0075, 0.0125, 0.02)
OUTSIDE = 1e-9


class Silence(NamedTuple):
    """Motion after one tick: largest distance outside X, as a share of its half-widths, negative inside."""

    within_short: float
    within_long: float


def measure(seeds: range) -> dict[str, list[Silence]]:
    """Return every case's outages, over all seeds and ticks."""
    found: dict[str, list[Silence]] = {}
    for seed, delay in product(seeds, DELAYS):
        config = load(None, [f"seed={seed}"])
        run = follow(config, STEPS, Faults(command_seconds=delay)).run
        cores = {margin: ControllerCore(_with(config, margin), CONTROLLER) for margin in MARGINS}
        for tick in run.ticks:
            said = {margin: _said(core, tick) for margin, core in cores.items()}
            command = said[MARGINS[0]][0]
            backups = {margin: backup for margin, (_command, backup) in said.items()}
            for what, plant, backup in _followed(cores[MARGINS[0]].plant, backups):
                silence = _silence(config, plant, tick, command, delay, backup)
                found.setdefault(f"{1e3 * delay:g} ms: {what}", []).append(silence)
    return found


def _followed(
    plant: Description, backups: dict[float, m.Backup | None]
) -> Iterator[tuple[str, Description, m.Backup | None]]:
    yield "plan, then constant input", replace(plant, safe_gain=None), None
    yield "plan, then feedback", plant, None
    for margin, backup in backups.items():
        yield f"policy, margin {100 * margin:g} %, then feedback", plant, backup


def _with(config: Config, margin: float) -> Config:
    backup = msgspec.structs.replace(config.controller.backup, margin=margin)
    return msgspec.structs.replace(
        config, controller=msgspec.structs.replace(config.controller, backup=backup)
    )


def _said(core: ControllerCore, tick: m.Tick) -> tuple[m.Command, m.Backup | None]:
    command = core.step(tick).command
    return command, core.backup(command)


def _silence(
    config: Config,
    plant: Description,
    tick: m.Tick,
    command: m.Command,
    delay: float,
    backup: m.Backup | None,
) -> Silence:
    """Simulate the true plant from this tick's sample on, with its last command and none after it."""
    assert tick.state is not None
    truth = true_motion(build_plant(config))
    sim = PlantSim(plant, truth, config.period, np.array(tick.state.x), config.plant.plan_patience, PLANT)
    sim.sample(0.0)
    sim.command(msgspec.structs.replace(command, state_seq=0), delay)
    if backup is not None:
        sim.backup(backup)
    half = plant.x_scale
    depths: list[float] = []
    for k in range(1, round(LONG * config.rate) + 1):
        try:
            x = np.array(sim.sample(k * config.period).x)
        except PlantError:
            depths.append(np.inf)
            continue
        depths.append(float(np.max(np.maximum(plant.x_min - x, x - plant.x_max) / half)))
    return Silence(max(depths[: round(SHORT * config.rate)]), max(depths))


def table(found: dict[str, list[Silence]]) -> str:
    """Markdown."""
    lines = [
        "| what is followed | outages | leave X within 3 s | of these after the third tick | deepest, % of half-width: "
        "median, worst | leave X within 6 s | worst |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, silences in found.items():
        left = [k for k, one in enumerate(silences) if one.within_short > OUTSIDE]
        deep = [100 * silences[k].within_short for k in left] or [0.0]
        longer = [100 * one.within_long for one in silences if one.within_long > OUTSIDE] or [0.0]
        late = sum(k % STEPS > 2 for k in left)
        lines.append(
            f"| {name} | {len(silences)} | {len(left)} | {late} | {np.median(deep):.2f}, {max(deep):.2f} "
            f"| {sum(value > 0 for value in longer)} | {max(longer):.2f} |"
        )
    return "\n".join(lines)


def main(seeds: int = 3, document: Path | None = None) -> None:
    """Measure the motion of the true plant after its controller falls silent.

    Args:
        seeds: runs, from seed 0 on.
        document: file that takes the table between its marks.
    """
    marks = Marks.of("outage", "python -m verification.outage")
    marks.check(document)
    text = table(measure(range(seeds)))
    marks.put(document, f"`python -m verification.outage --seeds {seeds}`\n\n{text}")
    Console(width=160).print(text)


if __name__ == "__main__":
    tyro.cli(main)
