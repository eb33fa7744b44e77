"""Solve times, measured on this machine when nothing else of the experiment runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec

from node_runtime import provenance
from node_runtime.config.sections import AdaptationConfig, Config, SensorsConfig
from node_runtime.whole_file import read_regular, write_whole
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow
from tandem.experiments.study.declaration import Resolved
from tandem.experiments.study.isolated import ORDINARY, Children, Failure, Limits
from tandem.experiments.study.plan import Job
from tandem.experiments.study.runner import Progress


class Timing(msgspec.Struct, frozen=True):
    """Solve times, (n,) milliseconds, of some runs of one problem."""

    runs: list[list[float]]
    processor: str
    """Processor of the machine that measured them."""


def timing_job(case: Resolved, seed: int, seconds: float) -> Job:
    """Return the job that stands for all cases with the same solver work: oracle, horizon, network and rate."""
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
    limits: Limits = ORDINARY,
) -> dict[str, Timing]:
    """Measure the solve times by case name, in one process without other load.

    Times of this processor that are already in `folder` are used. A case whose run fails has none.

    repeats: smallest number of runs of a case; seconds: duration of control in each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    processor = provenance.describe()["processor"]
    keys = {case.name: timing_job(case, 0, seconds).key for case in cases}
    by_key = {keys[case.name]: case for case in cases}
    most = dict.fromkeys(by_key, 0)
    for case in cases:
        most[keys[case.name]] = max(most[keys[case.name]], repeats(case))
    timings: dict[str, Timing] = {}
    children = Children()
    try:
        for done, (key, case) in enumerate(by_key.items(), 1):
            path = folder / f"{key}.json"
            timing = _read(path, processor)
            while len(timing.runs) < most[key]:
                job = timing_job(case, len(timing.runs), seconds)
                with children.one() as child:
                    times = child.call(_time, job, limits=limits)
                if isinstance(times, Failure):
                    break
                timing = Timing([*timing.runs, times], processor)
                write_whole(path, msgspec.json.encode(timing))
            if timing.runs:
                timings[key] = timing
            progress(done, len(by_key))
    finally:
        children.kill()
    return {case.name: timings[keys[case.name]] for case in cases if keys[case.name] in timings}


def _read(path: Path, processor: str) -> Timing:
    try:
        timing = msgspec.json.decode(read_regular(path), type=Timing)
    except (OSError, msgspec.DecodeError):
        return Timing([], processor)
    return timing if timing.processor == processor else Timing([], processor)


def _time(job: Job) -> list[float]:
    return [timing.solve_ms for timing in follow(job.config, job.steps).run.timings]
