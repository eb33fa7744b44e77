"""The cost of each oracle with a wrong nominal model: `python -m verification.wrong_models`.

Lock-step runs in episodes of the compressor with other parameters than its model's, and of two of the examples, at
several horizons. Requirement where `perfect`, which knows the true plant, keeps X: the network is within 2 % of the
better of it and the best constant h_hat from the second episode on, and within 10 % in the first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path

import msgspec
import numpy as np
import tyro
from rich.console import Console

from node_runtime.config.loading import load
from node_runtime.config.shipped import config_file
from run_log.reporting.summary import summarise
from run_log.run import Run, plant_of
from tandem.experiments.simulation.lockstep import follow

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
LATER, FIRST = 1.02, 1.10
"""Largest J of the network relative to the better of `perfect`'s and the best constant's."""
ROWS = {
    "linear": ["controller.oracle=linear"],
    **{f"constant {g}": ["controller.oracle=constant", f"constant.gain={g}"] for g in (0.2, 0.5, 1)},
    "l2nw": ["controller.oracle=l2nw"],
    "dnn": ["controller.oracle=dnn"],
    "perfect": ["controller.oracle=perfect"],
}


@dataclass(frozen=True)
class Wrong:
    """A plant with a wrong model."""

    config: str
    """A shipped configuration, or a file."""
    settings: list[str]
    steps: int = 200
    """Number of steps in an episode."""
    second: float = 1.0
    """Seconds of one unit of the horizon: slow plants need minutes."""


def _truth(parameters: dict[str, float]) -> list[str]:
    return [f"plant.truth.{name}={value}" for name, value in parameters.items()]


def _compressors() -> Iterator[tuple[str, Wrong]]:
    near = "plant.x0=[0.4, 1.6, 1.1547, 0.0]"
    for config, start in (("compressor-cheap", []), ("compressor", [near])):
        for truth in ({"slope": 1.4}, {"slope": 1.6}, {"beta": 1.3}, {"z_c": 0.05}):
            ((name, value),) = truth.items()
            yield f"{config} {name}={value:g}", Wrong(config, [*start, *_truth(truth)])


WRONG = {
    **dict(_compressors()),
    "tanks": Wrong(str(EXAMPLES / "tanks" / "tanks.toml"), [], second=60.0),
    "quadrotor": Wrong(str(EXAMPLES / "quadrotor" / "quadrotor.toml"), [], steps=250),
}


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One oracle on one plant at one horizon; from the second episode on a figure is the mean over episodes."""

    plant: str
    horizon: float
    oracle: str
    J: list[float]
    """J of each episode; infinite from the episode in which the plant was lost."""
    violations: int
    """Samples outside X or U, in all episodes."""
    iteration_limit: int
    soft: int
    """Ticks with slack."""
    fallback: int
    chatter: float
    """Largest second difference of the input in the second half of the last episode, in half-widths."""
    lost: str | None

    @property
    def first(self) -> float:
        return self.J[0]

    @property
    def later(self) -> float:
        return float(np.mean(self.J[1:])) if len(self.J) > 1 else math.nan


def run_one(plant: str, horizon: float, oracle: str, episodes: int, more: list[str]) -> Row:
    """Return one run; deterministic."""
    wrong = WRONG[plant]
    seconds = f"controller.horizon_seconds={horizon * wrong.second}"
    config = load(config_file(wrong.config), [*wrong.settings, *ROWS[oracle], *more, seconds])
    outcome = follow(config, wrong.steps, episodes=episodes)
    summary = summarise(outcome.run)
    costs = [one.J for one in summary.episodes]
    if outcome.lost is not None:
        costs = [*costs[:-1], *[math.inf] * (episodes - len(costs) + 1)]
    return Row(
        plant=plant,
        horizon=horizon,
        oracle=oracle,
        J=costs,
        violations=summary.constraint_violations,
        iteration_limit=summary.iteration_limit_ticks,
        soft=summary.soft_ticks,
        fallback=summary.fallback_ticks,
        chatter=_chatter(outcome.run, wrong.steps // 2),
        lost=outcome.lost,
    )


def _chatter(run: Run, last: int) -> float:
    u = np.array([command.u for command in run.commands])[-last:]
    turns = np.abs(np.diff(u, 2, axis=0)) / plant_of(run).u_scale
    return float(turns.max(initial=0.0))


def verdict(rows: list[Row]) -> tuple[bool, str]:
    """Return whether the requirement is met, and a sentence; `rows` are all oracles of one plant and horizon."""
    of = {row.oracle: row for row in rows}
    perfect, dnn = of.get("perfect"), of.get("dnn")
    constants = [row for name, row in of.items() if name.startswith("constant")]
    if perfect is None or dnn is None or not constants:
        return True, ""
    if perfect.lost is not None or perfect.violations:
        return True, "nothing is asked: perfect does not keep X"
    parts, met = [], True
    for what, share in (("first", FIRST), ("later", LATER)):
        best = min(getattr(row, what) for row in (perfect, *constants))
        ratio = getattr(dnn, what) / best
        if not math.isnan(ratio):
            met &= ratio <= share
            parts.append(f"{what} {100 * (ratio - 1):+.1f} %")
    return met, f"{'met' if met else 'NOT met'}: dnn against the better one: {', '.join(parts)}"


def show(rows: list[Row], console: Console) -> bool:
    """Print a line a run and a verdict for each plant and horizon; return whether all are met."""
    all_met = True
    for (plant, horizon), group in groupby(rows, key=lambda row: (row.plant, row.horizon)):
        same = list(group)
        console.print(f"\n{plant}, horizon {horizon:g} x {WRONG[plant].second:g} s", highlight=False)
        console.print(
            "  oracle        J first   J later  outside  limit  soft  fallback  chatter", highlight=False
        )
        for row in same:
            counts = f"{row.violations:7d}  {row.iteration_limit:5d}  {row.soft:4d}  {row.fallback:8d}"
            end = f"  {row.chatter:7.4f}{'  lost ' + row.lost if row.lost else ''}"
            console.print(
                f"  {row.oracle:12s} {row.first:8.4g}  {row.later:8.4g}  {counts}{end}", highlight=False
            )
        met, words = verdict(same)
        all_met &= met
        console.print(f"  {words}", highlight=False)
    return all_met


def main(
    plants: tuple[str, ...] = tuple(WRONG),
    horizons: tuple[float, ...] = (1.0, 2.0, 3.0),
    oracles: tuple[str, ...] = tuple(ROWS),
    episodes: int = 5,
    set: tuple[str, ...] = (),
    jobs: int = 1,
    json: bool = False,
) -> int:
    """Run and print; return 1 if a requirement is not met.

    Args:
        plants: names of `WRONG`.
        horizons: in seconds, of a slow plant in its own unit.
        oracles: names of `ROWS`.
        episodes: times that the plant is started.
        set: further settings, section.key=value.
        jobs: processes.
        json: rows as JSON instead of a table.
    """
    wanted = [(plant, horizon, oracle) for plant in plants for horizon in horizons for oracle in oracles]
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        futures = [pool.submit(run_one, *one, episodes, list(set)) for one in wanted]
        rows = [future.result() for future in futures]
    if json:
        print(msgspec.json.encode(rows).decode())  # noqa: T201
        return 0
    return 0 if show(rows, Console()) else 1


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
