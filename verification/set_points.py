"""Tracking of set-points with a wrong model: `python -m verification.set_points`.

Lock-step runs of the compressor with a slope of 1.4 instead of its model's 1.5, of the tanks, and of the quadrotor in
wind. The table has the distance of an output from its set-point some seconds after each step. For the compressor it
also has the distance on a ramp, with a preview and without, and the processor time of a step.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.shipped import config_file
from tandem.experiments.simulation.lockstep import LockStep
from tandem.loop import Loop
from tandem.operating.set_points import set_point, trajectory

HALF = 0.5
"""Half-width of y."""
EACH = 1.2
"""Duration of a step, as a share of the time after which it is evaluated."""
RAMP = ([0.0, 4.0, 8.0, 10.0], [1.65, 1.65, 1.75, 1.75])
WARM = 40
"""Ticks that are not timed."""


@dataclass(frozen=True)
class Steps:
    """Set-points of a plant, one after the other."""

    config: str
    """A shipped configuration, or a file."""
    values: dict[str, tuple[float, ...]]
    after: float = 5.0
    """Seconds after each step at which it is evaluated."""


START = ["plant.truth.slope=1.4", "plant.x0=[0.4, 1.6, 1.1547, 0.0]"]
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
STEPS = {
    "compressor": Steps("compressor-cheap", {"y": (1.65, 1.7, 1.6, 1.68, 1.75, 1.65, 1.7)}),
    # Five times the time constant of a tank.
    "tanks": Steps(str(EXAMPLES / "tanks" / "tanks.toml"), {"h2": (10.0, 8.0, 11.0, 9.0, 10.0)}, 300.0),
    "quadrotor": Steps(
        str(EXAMPLES / "quadrotor" / "quadrotor.toml"),
        {"y": (0.0, 0.5, 0.5, -0.5, 0.0), "z": (0.0, 0.0, 0.5, -0.5, 0.0)},
    ),
}


@dataclass(frozen=True)
class SetPoints:
    """What is measured."""

    plants: list[str] = field(default_factory=lambda: list(STEPS))
    oracles: list[str] = field(default_factory=lambda: ["linear", "constant", "dnn", "perfect"])
    set: list[str] = field(default_factory=list)
    """Other settings, SECTION.KEY=VALUE."""


def main(chosen: SetPoints) -> int:
    """Prints the tables."""
    for plant in chosen.plants:
        steps = STEPS[plant]
        rows = [", ".join(f"{value:g}" for value in row) for row in zip(*steps.values.values(), strict=True)]
        _say(f"| {plant}, {', '.join(steps.values)} |", " | ".join(f"to {row}" for row in rows) + " |")
        for oracle in chosen.oracles:
            found = _steps(_config(oracle, chosen, steps.config), steps)
            _say(f"| `{oracle}` |", " | ".join(f"{100 * off:.3f}" for off in found) + " |")
    if "compressor" not in chosen.plants:
        return 0
    for oracle in chosen.oracles:
        before, now = (_ramp(_config(oracle, chosen), previewed) for previewed in (False, True))
        _say(f"| `{oracle}`, ramp |", f"{100 * before:.2f} | {100 * now:.2f} | {now / before:.2f} |")
    for oracle in chosen.oracles:
        costs = _costs(_config(oracle, chosen, "compressor"))
        _say(f"| `{oracle}`, cost of a step |", " | ".join(f"{one:.2f}" for one in costs) + " |")
    return 0


def _config(oracle: str, chosen: SetPoints, name: str = "compressor-cheap") -> Config:
    start = START if name.startswith("compressor") else []
    return load(config_file(name), [*start, f"controller.oracle={oracle}", *chosen.set])


def _steps(config: Config, steps: Steps) -> Iterator[float]:
    """Largest |y - r| so many seconds after each step, in half-widths; each step is given when it begins."""
    loop = Loop(config=config)
    own = [loop.plant.states.index(name) for name in steps.values]
    for row in zip(*steps.values.values(), strict=True):
        loop.set_point(dict(zip(steps.values, row, strict=True)))
        states = [loop.step().x for _ in range(round(EACH * steps.after * config.rate))]
        off = states[round(steps.after * config.rate)][own] - row
        yield float((abs(off) / loop.plant.x_scale[own]).max())


def _ramp(config: Config, previewed: bool) -> float:
    """Mean |y - r| on the ramp, in half-widths. Without a preview, each period asks for the present value."""
    loop, (times, values) = LockStep(config), RAMP
    off = []
    for step in range(round(times[2] * config.rate)):
        t = step * config.period
        r = float(np.interp(t, times, values))
        if not previewed:
            loop.ask(set_point({"y": r}))
        elif step == 0:
            loop.ask(trajectory(times, {"y": values}))
        state, _outputs = loop.step()
        if t >= times[1]:
            off.append(abs(state.x[1] - r) / HALF)
    return float(np.mean(off))


def _costs(config: Config) -> list[float]:
    """Processor time of a step with a set-point, on a ramp and with a corner ahead, relative to a step without one."""
    asked = [None, set_point({"y": 1.7}), trajectory([0.0, 1e3], {"y": [1.62, 1.82]}), None]
    corner = trajectory([0.0, 0.4, 1.0], {"y": [1.65, 1.65, 1.67]})
    loops = [LockStep(config) for _ in asked]
    for loop, first in zip(loops, asked, strict=True):
        if first is not None:
            loop.ask(first)
    spent = np.zeros((WARM + 80, len(loops)))
    for step in spent:
        loops[-1].ask(corner)
        for i, loop in enumerate(loops):
            before = time.process_time()
            loop.step()
            step[i] = time.process_time() - before
    middle = np.median(spent[WARM:], axis=0)
    return (middle[1:] / middle[0]).tolist()


def _say(name: str, text: str) -> None:
    sys.stdout.write(f"{name} {text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(tyro.cli(SetPoints)))
