"""The cost of learning with noisy sensors: `python -m verification.noisy_plants --out DIR`.

Lock-step runs of four plants with white noise on all states and an estimator that knows its size. J is that of the
true states. Requirements on the network at each level of noise: its median J is at most 1.03 times the smaller median
of linear MPC and of the best constant; each seed's J is at most 1.15 times the best of that seed; no plant is lost;
and it leaves X at most 1.2 times as often as linear MPC or the true h. With `--episodes 5`, later episodes must be
within 5 % of those with the true h.

Finished runs stay in the folder, and the same command continues from there.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from statistics import median
from typing import NamedTuple

import msgspec
import tyro
from rich.console import Console
from rich.table import Table

from node_runtime.config.loading import load
from node_runtime.config.shipped import config_file
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.study.plan import Job
from tandem.experiments.study.runner import Processes, Want, run_all
from tandem.experiments.study.work import Record

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NEAR = "plant.x0=[0.4, 1.6, 1.1547, 0.0]"
MEDIAN, SEED, OUTSIDE, LATER, EXACT = 1.03, 1.15, 1.2, 1.05, 1.01
GAINS = (0.02, 0.2, 0.5, 1.0)
ORACLES = {
    "linear": ["controller.oracle=linear"],
    **{f"constant {gain:g}": ["controller.oracle=constant", f"constant.gain={gain}"] for gain in GAINS},
    "dnn": ["controller.oracle=dnn"],
    "perfect": ["controller.oracle=perfect"],
}
NO_ESTIMATOR = "none"


class Noisy(NamedTuple):
    """A plant, and the runs of it."""

    config: str
    """A shipped configuration, or a file."""
    settings: list[str]
    steps: int = 200
    """Number of steps in an episode."""


PLANTS = {
    "compressor-cheap": Noisy("compressor-cheap", []),
    "compressor": Noisy("compressor", [NEAR]),
    "tanks": Noisy(str(EXAMPLES / "tanks" / "tanks.toml"), []),
    "quadrotor": Noisy(str(EXAMPLES / "quadrotor" / "quadrotor.toml"), [], 250),
    "compressor slope=1.4": Noisy("compressor", [NEAR, "plant.truth.slope=1.4", "reference.outputs=[]"]),
}


class Case(NamedTuple):
    """Runs that differ in their seed alone."""

    plant: str
    level: str
    """Noise as a share of half-widths; "none": no noise, and no estimator."""
    oracle: str


class Row(NamedTuple):
    """Results of a case, one entry a seed."""

    J: list[float]
    """J of the first episode; infinite if the plant was lost in it."""
    later: list[float]
    """The worst J of the other episodes; NaN without any."""
    outside: int
    """Samples outside X or U, of all seeds."""
    lost: int
    """Seeds."""


def job(case: Case, seed: int, episodes: int, more: list[str]) -> Job:
    """Return one run of a case; deterministic."""
    noisy, level = PLANTS[case.plant], case.level
    noise = [f"plant.sensors.noise={level}", f"estimator.noise={level}", "estimator.kind=kalman"]
    settings = [*noisy.settings, *([] if level == NO_ESTIMATOR else noise), *ORACLES[case.oracle]]
    config = load(config_file(noisy.config), [*settings, *more, f"seed={seed}"])
    if case.oracle != "dnn" and not config.plant.sensors.random:
        # Nothing is random, so all seeds are one run.
        config = msgspec.structs.replace(config, seed=0)
    return Job(config=config, steps=noisy.steps, episodes=episodes, faults=Faults())


def row(records: list[Record]) -> Row:
    """Of one case's runs."""
    first = [one.episodes[0].J if one.episodes else float("inf") for one in records]
    later = [
        float("inf") if one.lost is not None else max((e.J for e in one.episodes[1:]), default=float("nan"))
        for one in records
    ]
    outside = sum(one.performance.constraint_violations for one in records)
    return Row(first, later, outside, sum(one.lost is not None for one in records))


def failures(rows: dict[str, Row], without: Row | None = None) -> list[str]:
    """List unmet requirements on dnn at one level; `rows` by oracle, `without`: dnn without noise and estimator."""
    dnn, others = rows["dnn"], {name: one for name, one in rows.items() if name not in ("dnn", "perfect")}
    best = min(median(one.J) for one in others.values())
    worst = max(
        mine / min(theirs) for mine, *theirs in zip(dnn.J, *(one.J for one in others.values()), strict=True)
    )
    found = []
    if not median(dnn.J) <= MEDIAN * best:
        found.append(f"median J is {median(dnn.J) / best:.3f} of the best one's")
    if not worst <= SEED:
        found.append(f"one seed's J is {worst:.2f} of its best one's")
    if dnn.lost:
        found.append(f"{dnn.lost} lost")
    allowed = max(rows[name].outside for name in ("linear", "perfect") if name in rows)
    if dnn.outside > OUTSIDE * allowed:
        found.append(f"{dnn.outside} samples outside X, {allowed} at most otherwise")
    if without is not None and abs(median(dnn.J) / median(without.J) - 1.0) > EXACT - 1.0:
        found.append(f"the estimator alone makes J {median(dnn.J) / median(without.J):.3f} times as large")
    if "perfect" in rows and median(dnn.later) > LATER * median(rows["perfect"].later):
        found.append(f"later episodes: {median(dnn.later) / median(rows['perfect'].later):.3f} of perfect's")
    return found


def show(rows: dict[Case, Row], console: Console) -> bool:
    """Print a line for each plant and level; return whether all requirements are met."""
    table = Table("plant", "noise", *ORACLES, "", box=None)
    met = True
    for plant, level in dict.fromkeys((case.plant, case.level) for case in rows):
        of = {case.oracle: one for case, one in rows.items() if (case.plant, case.level) == (plant, level)}
        without = rows.get(Case(plant, NO_ESTIMATOR, "dnn")) if float(_number(level)) == 0.0 else None
        bad = failures(of, without)
        met &= not bad
        costs = [f"{median(of[name].J):.4g}" if name in of else "" for name in ORACLES]
        table.add_row(plant, level, *costs, "; ".join(bad) or "met")
    console.print(table)
    for plant in dict.fromkeys(case.plant for case in rows):
        gains = {}
        for level in dict.fromkeys(case.level for case in rows if case.plant == plant):
            gains[level] = median(rows[Case(plant, level, "linear")].J) - median(
                rows[Case(plant, level, "dnn")].J
            )
        if gains.get(NO_ESTIMATOR, 0.0) > 0.0:
            kept = ", ".join(f"{level}: {gain / gains[NO_ESTIMATOR]:.0%}" for level, gain in gains.items())
            console.print(f"{plant}: of J_linear - J_dnn without noise stays {kept}", highlight=False)
    return met


def _number(level: str) -> str:
    return "nan" if level == NO_ESTIMATOR else level


def main(
    out: Path,
    plants: tuple[str, ...] = tuple(PLANTS),
    levels: tuple[str, ...] = (NO_ESTIMATOR, "0", "0.001", "0.003", "0.01", "0.02"),
    oracles: tuple[str, ...] = tuple(ORACLES),
    seeds: int = 20,
    episodes: int = 1,
    set: tuple[str, ...] = (),
    jobs: int = 1,
) -> int:
    """Run and print; return 1 if a requirement is not met.

    Args:
        out: a folder for the runs.
        plants: names of `PLANTS`.
        levels: standard deviation of the noise, as a share of half-widths; "none": no noise, and no estimator.
        oracles: names of `ORACLES`; linear and dnn are needed.
        seeds: how many, from 0 on.
        episodes: times that the plant is started.
        set: further settings, section.key=value.
        jobs: processes.
    """
    cases = [Case(*names) for names in ((p, n, o) for p in plants for n in levels for o in oracles)]
    runs = {case: [job(case, seed, episodes, list(set)) for seed in range(seeds)] for case in cases}
    wants = {one.key: Want(one, False, ()) for jobs_ in runs.values() for one in jobs_}
    with closing(Processes(jobs)) as processes:
        records, failures = run_all(wants, out, processes)
    for failure in failures.values():
        raise SystemExit(f"a run failed: {failure.text}")
    rows = {case: row([records[one.key] for one in ones]) for case, ones in runs.items()}
    (out / "rows.json").write_bytes(msgspec.json.encode([[*case, *one] for case, one in rows.items()]))
    return 0 if show(rows, Console()) else 1


if __name__ == "__main__":
    raise SystemExit(tyro.cli(main))
