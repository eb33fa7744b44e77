"""Check that a rate limit of the input holds for every source of input: `python -m verification.input_rates`.

Automatic, in each seed: the compressor starts at another state, commands come up to a fifth of a period early or
late, and the controller is silent repeatedly, for up to twice its horizon. Plan, backup policy and safe input
act. Every written input is stored with its time. Manual, in lock-step: a person drives by random inputs at times,
until a random moment or until the plant would leave X; the last row has a dead time.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from controller_node.core import ControllerCore
from lbmpc.plants import PlantError, Truth
from lbmpc.plants.moore_greitzer import MOORE_GREITZER
from node_runtime.config.loading import load, override
from node_runtime.config.sections import Config
from plant_sim.shield import Shield
from plant_sim.simulator import Motion
from protocol import messages as m
from tandem.experiments.simulation.lockstep import LockStep

SETTINGS = ["controller.horizon=20", "trainer.enabled=false", "network.hidden=[8,8]"]
LATE = 0.2
"""Largest share of a period by which a command is early or late, about its usual time."""
BY_HAND = [
    "plant.x0=[0.4, 1.6, 1.1547, 0.0]",
    "controller.oracle=constant",
    "controller.solver.compile=never",
]
DEAD_TIME = 0.125
"""Seconds, a fraction of a period too: dead time of one more row."""
SILENT = 0.08
"""Share of the ticks at which a silence begins."""


@dataclass(frozen=True)
class Found:
    """Result of one seed. Shares are of rate x period; at most 1 where the limit holds."""

    steps: float
    """Largest difference of two inputs that acted within one period."""
    samples: float
    """Largest difference of `applied` from sample to sample: means over a period."""
    sources: dict[str, int]
    """Number of samples by the source that acted before them."""


class Recording(Motion):
    """A simulated plant that stores what is written to it."""

    def __init__(self, *args: object, **options: object):
        super().__init__(*args, **options)  # type: ignore[arg-type]
        self.written: list[tuple[float, float]] = []

    def write(self, u: np.ndarray, due: float) -> float:
        self.written.append((due, float(u[0])))
        return super().write(u, due)


def follow(config: Config, seed: int, ticks: int) -> Found:
    """Run one seed for `ticks` ticks."""
    rng, plant, period = np.random.default_rng(seed), MOORE_GREITZER, config.period
    core = ControllerCore(override(config, [f"seed={seed}"]), "controller")
    x0 = plant.x_e + rng.uniform(-0.4, 0.4, 4) * plant.x_scale * [1.0, 1.0, 0.2, 0.01]
    motion = Recording(Truth(plant), x0, period)
    shield = Shield(core.plant, period, config.plant.plan_patience, "plant", held=True)
    applied, sources, silent, usual = [], dict[str, int](), 0, 0.3 * period
    first = float(core.plant.safe_input[0])
    for k in range(ticks):
        t = k * period
        try:
            shield.advance(t, motion)
            state = shield.sample(t, motion.read(t))
        except PlantError:
            # The plant was without commands for too long; inputs written until then count.
            break
        shield.renew(t, np.array(state.x), motion)
        sources[state.source] = sources.get(state.source, 0) + 1
        if state.applied is not None:
            applied.append(state.applied[0])
        outputs = core.step(m.Tick.punctual("controller", k, period, state))
        silent = silent - 1 if silent else int(rng.integers(1, 40)) * int(rng.random() < SILENT)
        if silent:
            continue
        shield.command(outputs.command, t + usual + rng.uniform(-LATE, LATE) * period)
        if rng.random() < 0.5 and (backup := core.backup(outputs.command)) is not None:
            shield.backup(backup)
    rate = float(core.plant.input_rates[0])
    steps = _largest([(-np.inf, first), *motion.written], rate, period)
    samples = float(np.abs(np.diff(applied)).max()) / (rate * period)
    return Found(steps, samples, sources)


def by_hand(config: Config, seed: int, ticks: int) -> Found:
    """Run one seed for `ticks` ticks, with manual control at times; shares as in `Found`."""
    rng, plant = np.random.default_rng(seed), MOORE_GREITZER
    loop = LockStep(config)
    states, until = [], int(rng.integers(5, 20))
    for k in range(ticks):
        if k == until:
            if loop.person.by_hand is None:
                loop.manual(rng.uniform(plant.u_min, plant.u_max))
            else:
                loop.auto()
            until += int(rng.integers(2, 20))
        try:
            states.append(loop.step()[0])
        except PlantError:
            # The plant left X with so slow an input; inputs written until then count.
            break
    rate, period = float(loop.core.plant.input_rates[0]), config.period
    written, t = [(-np.inf, float(plant.safe_input[0]))], 0.0
    for state in states[1:]:
        for piece in state.pieces or [m.Piece(seconds=period, u=state.applied or [])]:
            written.append((t, piece.u[0]))
            t += piece.seconds
    applied = [state.applied[0] for state in states if state.applied is not None]
    counted = Counter[str](state.source for state in states)
    samples = float(np.abs(np.diff(applied)).max()) / (rate * period)
    return Found(_largest(written, rate, period), samples, dict(counted))


def _largest(written: list[tuple[float, float]], rate: float, period: float) -> float:
    times, inputs = np.array(written).T
    # An input ends where the next one begins.
    apart = times[None, :] - times[1:, None]
    within = (apart >= 0.0) & (apart < (1.0 - 1e-6) * period)
    return float(np.abs(inputs[None, :] - inputs[:-1, None])[within].max()) / (rate * period)


@dataclass(frozen=True)
class Arguments:
    """Check that a rate limit of the input holds, through jitter, silence of the controller and manual control."""

    seeds: int = 20
    ticks: int = 200
    rate: Annotated[float, tyro.conf.arg(help="input_rate_max of u, per second.")] = 0.4


def main(chosen: Arguments) -> int:
    config = load("compressor", [*SETTINGS, f"plant.input_rate_max.u={chosen.rate}"])
    console = Console(width=120, highlight=False)
    hand = override(config, BY_HAND)
    late = override(hand, [f"plant.dead_time={DEAD_TIME}"])
    rows = [("", config, follow)] * chosen.seeds + [("by hand", hand, by_hand)] * chosen.seeds
    seeds = [*range(chosen.seeds), *range(chosen.seeds), 0]
    found = []
    console.print("seed | written | applied | samples by source")
    for seed, (what, settings, run) in zip(
        seeds, [*rows, ("by hand, dead time", late, by_hand)], strict=True
    ):
        one = run(settings, seed, chosen.ticks)
        found.append(one)
        by_source = ", ".join(f"{count} {source}" for source, count in sorted(one.sources.items()))
        console.print(
            f"{seed:4d} | {one.steps:7.4f} | {one.samples:7.4f} | {by_source}{what and f'; {what}'}"
        )
    held = all(max(one.steps, one.samples) <= 1.0 + 1e-5 for one in found)
    console.print("the limit holds" if held else "THE LIMIT IS BROKEN")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, prog="python -m verification.input_rates")))
