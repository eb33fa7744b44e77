"""What the trial of hidden weights admits: `python -m verification.stolen_trainer` prints the tables of attacks.

Lock-step runs of the paper's start: without an attack, with measurement noise, and with a stolen trainer that sends a
set at every tick, at every seventh tick, or in place of each trained set; each with the trial and without it.
Settings after the number of seeds apply to every run. Then only runs with the trial are made. With noise:

    python -m verification.stolen_trainer 1 plant.sensors.noise=0.01 estimator.kind=kalman
"""

from __future__ import annotations

import sys

import numpy as np
from rich.console import Console
from rich.table import Table

from node_runtime.config.loading import load
from run_log.reporting.summary import summarise
from run_log.run import Run
from tandem.experiments.simulation.lockstep import follow
from verification.attacks import Forge, crude, drift, elsewhere, follow_attacked, noise, random, reversed_sign

STEPS = 200
SEEDS = range(3)
DISTURBANCES: dict[str, list[str]] = {
    "none": [],
    "noise of 3e-4 on z and y": ["plant.sensors.noise={z=6e-4, y=6e-4}"],
    "noise of 1e-3 on z and y": ["plant.sensors.noise={z=2e-3, y=2e-3}"],
}
ATTACKS: dict[str, Forge] = {
    "NaN, huge, wrong shape, reversed, random": crude,
    "random": random,
    "last hidden layer reversed": reversed_sign,
    "1 % noise": noise(0.01),
    "10 % noise": noise(0.1),
    "30 % noise": noise(0.3),
    "drift": drift,
    "right here, wrong elsewhere": elsewhere(1.0),
}
SENT = {"every tick": (1, False), "every 7th": (7, False), "instead": (1, True)}


def measure(seeds: range, settings: list[str]) -> Table:
    """One row a case: means over the seeds."""
    table = Table(
        "what is sent", "when", "trial", "adopted", "refused", "rolled back", "J", "overshoot", "outside"
    )
    for trial in (True,) if settings else (True, False):
        for name, sensors in {"none": []}.items() if settings else DISTURBANCES.items():
            changed = [*settings, *sensors]
            runs = [follow(load(None, [*_settings(seed, trial), *changed]), STEPS).run for seed in seeds]
            _row(table, (name, "-"), trial, runs)
        for name, forge in ATTACKS.items():
            for when, (every, instead) in SENT.items():
                runs = [
                    follow_attacked(
                        load(None, [*_settings(seed, trial), *settings]), STEPS, forge, every, instead
                    )
                    for seed in seeds
                ]
                _row(table, (name, when), trial, runs)
    return table


def _settings(seed: int, trial: bool) -> list[str]:
    return [f"seed={seed}", f"adaptation.trial.enabled={'true' if trial else 'false'}"]


def _row(table: Table, words: tuple[str, str], trial: bool, runs: list[Run]) -> None:
    found = [summarise(run) for run in runs]

    def mean(name: str) -> float:
        return sum(getattr(one, name) for one in found) / len(found)

    table.add_row(
        *words,
        "on" if trial else "off",
        *(f"{mean(name):.1f}" for name in ("weights_adopted", "weights_refused", "weights_rolled_back")),
        f"{mean('J'):.3f}",
        f"{np.mean([next(iter(one.overshoot.values())) for one in found]):.1%}",
        f"{mean('constraint_violations'):.1f}",
    )


if __name__ == "__main__":
    seeds = range(int(sys.argv[1])) if len(sys.argv) > 1 else SEEDS
    Console(width=140).print(measure(seeds, sys.argv[2:]))
