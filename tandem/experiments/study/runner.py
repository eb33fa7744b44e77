"""Runs what is not there yet, on all cores; then times the solver alone.

A run is the same in any process, so neither the number of processes nor an interruption changes a figure.
"""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import msgspec

from node_runtime.config.sections import AdaptationConfig, Config, SensorsConfig
from node_runtime.whole_file import read_regular, write_whole
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow
from tandem.experiments.study.declaration import Resolved
from tandem.experiments.study.plan import Job, RowPlan
from tandem.experiments.study.work import Record, read, work

Progress = Callable[[int, int], None]
"""Told what is done and of how many."""


LONGEST_NAME = 160
"""Letters of a case in a file's name, which may have 255 in all."""


class RunnerError(RuntimeError):
    """The runs cannot go on; the text says why and what to do."""


class Want(NamedTuple):
    """One job, and what is wanted of it beyond its figures."""

    job: Job
    detail: bool
    logs: tuple[Path, ...]
    """Two cases may be one job: each has a log of its own."""


def wanted(plans: list[RowPlan], detailed: set[str], logs: Path) -> dict[str, Want]:
    """Every job once, floors too, by key. `detailed`: groups whose pictures show traces."""
    wants: dict[str, Want] = {}

    def want(job: Job, detail: bool, *logs: Path) -> None:
        before = wants.get(job.key, Want(job, False, ()))
        wants[job.key] = Want(job, detail or before.detail, (*before.logs, *logs))

    for plan in plans:
        case = plan.case
        name = f"{file_name(case.name)}-seed{plan.job.config.seed}.mcap"
        want(plan.job, case.group in detailed, *([logs / name] if case.log and plan.x0 is None else []))
        want(plan.floor, False)
    return wants


def run_all(
    wants: dict[str, Want], folder: Path, processes: int, progress: Progress = lambda done, total: None
) -> dict[str, Record]:
    """Every job's record, by key; those that `folder` holds already are not run again.

    Raises:
        ConfigError: a configuration admits no controller.
        RunnerError: a process was killed.
        KeyboardInterrupt: after the runs that were under way have ended and been kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob("*.partial"):
        leftover.unlink()
    missing = [
        (key, want)
        for key, want in wants.items()
        if read(folder / f"{key}.json", want.detail) is None or not all(log.is_file() for log in want.logs)
    ]
    # Long ones first, or one of them would keep a single core busy at the end.
    missing.sort(key=lambda one: _effort(one[1].job), reverse=True)
    there = len(wants) - len(missing)
    progress(there, len(wants))
    with _workers(processes) as pool:
        try:
            futures = [
                pool.submit(work, want.job, key, folder, want.detail, want.logs) for key, want in missing
            ]
            for done, future in enumerate(as_completed(futures), there + 1):
                future.result()
                progress(done, len(wants))
        except BrokenProcessPool as error:
            raise RunnerError(
                "a process of the experiment was killed, for want of memory perhaps; the finished runs are kept: "
                "start the same command again, with fewer --jobs"
            ) from error
        finally:
            pool.shutdown(cancel_futures=True)
    records = {}
    for key, want in wants.items():
        record = read(folder / f"{key}.json", want.detail)
        if record is None:
            raise RunnerError(f"{folder}: {key}.json was deleted or damaged during the run; run again")
        records[key] = record
    return records


@contextmanager
def _workers(count: int) -> Iterator[ProcessPoolExecutor]:
    """Fresh processes that leave Ctrl-C to this one and import nothing from the current folder."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        with ProcessPoolExecutor(
            count, get_context("spawn"), initializer=_leave_ctrl_c_to_the_parent
        ) as pool:
            yield pool
    finally:
        del os.environ["PYTHONSAFEPATH"]
        if before is not None:
            os.environ["PYTHONSAFEPATH"] = before


def _leave_ctrl_c_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _effort(job: Job) -> float:
    learning = 5.0 if job.config.controller.oracle == "dnn" else 1.0
    return job.steps * job.episodes * job.config.controller.horizon * learning


def file_name(name: str) -> str:
    """Two names are two files, also where what a file's name had better not have is replaced."""
    clean = "".join(c if c.isascii() and (c.isalnum() or c in "-_=.") else "-" for c in name)[:LONGEST_NAME]
    return clean if clean == name else f"{clean}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


# -- solve times ---------------------------------------------------------------------------------------------


class Timing(msgspec.Struct, frozen=True):
    """Solve times, (n,) milliseconds, of some runs of one problem."""

    runs: list[list[float]]


def timing_job(case: Resolved, seed: int, seconds: float) -> Job:
    """What stands for all cases whose solver does the same work: oracle, horizon, network and rate."""
    config = case.config
    controller = msgspec.structs.replace(config.controller, W=None)
    given = config.plant
    truth = given.truth if isinstance(given.truth, str) else {}
    plant = msgspec.structs.replace(given, x0=None, truth=truth, sensors=SensorsConfig())
    config = msgspec.structs.replace(
        config, seed=seed, plant=plant, controller=controller, constant=Config().constant
    )
    if config.controller.oracle == "dnn":
        trainer = msgspec.structs.replace(Config().trainer, enabled=True)
        config = msgspec.structs.replace(config, adaptation=AdaptationConfig(), trainer=trainer)
    return Job(config=config, steps=round(seconds * config.rate), episodes=1, faults=Faults())


def time_all(
    cases: list[Resolved],
    repeats: Callable[[Resolved], int],
    seconds: float,
    folder: Path,
    progress: Progress,
) -> dict[str, Timing]:
    """Solve times by case name; one process, nothing beside it. Those in `folder` are taken as they are.

    repeats: runs of a case, at least; seconds: of control in each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    keys = {case.name: timing_job(case, 0, seconds).key for case in cases}
    by_key = {keys[case.name]: case for case in cases}
    most = dict.fromkeys(by_key, 0)
    for case in cases:
        most[keys[case.name]] = max(most[keys[case.name]], repeats(case))
    timings: dict[str, Timing] = {}
    with _workers(1) as pool:
        for done, (key, case) in enumerate(by_key.items(), 1):
            path = folder / f"{key}.json"
            try:
                timing = msgspec.json.decode(read_regular(path), type=Timing)
            except (OSError, msgspec.DecodeError):
                timing = Timing([])
            while len(timing.runs) < most[key]:
                times = pool.submit(_time, timing_job(case, len(timing.runs), seconds)).result()
                timing = Timing([*timing.runs, times])
                write_whole(path, msgspec.json.encode(timing))
            timings[key] = timing
            progress(done, len(by_key))
    return {case.name: timings[keys[case.name]] for case in cases}


def _time(job: Job) -> list[float]:
    return [timing.solve_ms for timing in follow(job.config, job.steps).run.timings]
