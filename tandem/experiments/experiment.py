"""A whole experiment: from its file to the report."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from lbmpc.plants import Description
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.whole_file import write_whole
from tandem.experiments.reporting.page import page
from tandem.experiments.study import results
from tandem.experiments.study.declaration import STEPS, Declaration, config_of, resolve
from tandem.experiments.study.plan import code_version, rows
from tandem.experiments.study.runner import Workplace, file_name, run_all, wanted
from tandem.experiments.study.timing import time_all

DETAILED = ("trajectories", "recovery", "lemma")
"""Pictures that need every sample."""
REPEATS = 3
SHORT = 0.2
"""Share of a timed run that is made with --quick."""

Progress = Callable[[str, int, int], None]
"""Called with the stage, the number of finished items and the total."""


class Finished(NamedTuple):
    report: Path
    summary: Path
    logs: int
    rows: list[results.Row]
    failed: list[results.FailedRun]


def run(
    declared: Declaration,
    where: str,
    plant: Description,
    out: Path,
    open_workplace: Callable[[Iterable[Config]], Workplace],
    command: str,
    quick: bool = False,
    only: str | None = None,
    repeats: int = REPEATS,
    progress: Progress = lambda stage, done, total: None,
) -> Finished:
    """Make the runs that are missing in `out`, time the solver, and write the report and the summary.

    Args:
        declared: the experiment.
        where: its file, for messages.
        plant: the controlled plant.
        out: a folder; its existing runs are used if settings and code are the same.
        open_workplace: opens the workplace for the runs' configurations.
        command: the command line, for the report.
        quick: fewer seeds, states and values.
        only: one group instead of all.
        repeats: number of timed runs of cases in the picture of solve times; other cases have one.
        progress: called with the progress.

    Raises:
        ConfigError: the experiment or a configuration in it cannot be used.
        RunnerError: no workplace is left, or every run failed.
        OSError: `out` cannot be written to.
        KeyboardInterrupt: finished runs are kept.
    """
    cases = resolve(declared, plant, where, quick)
    if only is not None:
        names = [group.name for group in declared.group]
        if only not in names:
            raise ConfigError(f"--only {only}: {where} has no such group; it has {', '.join(names)}")
        cases = [case for case in cases if case.group == only]
    base = settings(declared, where)
    detailed = {group.name for group in declared.group if group.picture in DETAILED}
    logs = out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    plans = list(rows(cases))
    wants = wanted(plans, detailed, logs)
    with closing(open_workplace(plan.job.config for plan in plans)) as workplace:
        records, failures = run_all(
            wants,
            out / "runs",
            workplace,
            lambda done, total: progress("running", done, total),
            declared.limits,
        )
    failed = results.failed(plans, failures)
    cases = results.with_results(cases, plans, records, failed)
    shown = {group.name for group in declared.group if group.picture == "trajectories"}
    timings = time_all(
        cases,
        lambda case: repeats if case.group in shown and not quick else 1,
        (declared.steps or STEPS) * base.period * (SHORT if quick else 1.0),
        out / "timings",
        lambda done, total: progress("timing the solver", done, total),
        declared.limits,
    )
    found = results.collect(plans, records, timings, plant)
    code = code_version()
    made = page(declared, found, plant, base, command, code, quick, len(failed))
    every = [row for result in found for row in result.rows]
    told = results.summary(declared, every, failed, timings, plant, command, code, quick)
    report, summary = out / "report.html", out / "summary.json"
    write_whole(report, made.html.encode())
    drawn = out / "pictures"
    drawn.mkdir(exist_ok=True)
    for name, png in made.pictures.items():
        write_whole(drawn / f"{file_name(name)}.png", png)
    write_whole(summary, msgspec.json.format(msgspec.json.encode(told), indent=1))
    return Finished(report, summary, sum(len(wants[key].logs) for key in records), every, failed)


def settings(declared: Declaration, where: str) -> Config:
    """Return the configuration before the changes of the cases. Raises `ConfigError`."""
    return config_of([declared], {}, where, Path(where).parent)


def overview(declared: Declaration) -> dict[str, Any]:
    """Return the entry of an experiment in `tandem experiment list`."""
    return {
        "name": declared.name,
        "title": declared.title,
        "groups": [group.name for group in declared.group],
    }
