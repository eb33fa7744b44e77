"""One run, in a process of its own: what it came to, in a file that appears whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from controller_node.build import build_model, build_network_oracle, build_plant
from lbmpc.plants import PlantError, get_plant, get_truth, true_motion
from node_runtime.config.plant import true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.whole_file import read_regular, require_regular, write_whole
from run_log.reporting.motion import trajectory
from run_log.reporting.performance import Performance, performance
from run_log.reporting.summary import summarise
from run_log.run import Run, plant_of
from run_log.writing.save import save
from tandem.experiments.simulation import wave
from tandem.experiments.simulation.lockstep import Outcome, follow
from tandem.experiments.study.lemma import Lemma, measure
from tandem.experiments.study.plan import Job

Rests = tuple[np.ndarray, np.ndarray]
"""Where the true plant rests at the set-points of each tick of a cycle, as of `wave.rests`."""


class Traces(msgspec.Struct, frozen=True, kw_only=True):
    """n samples, from the start on."""

    x: list[list[float]]
    """(n, p) the plant's performance states, its own units."""
    u: list[list[float]]
    """(n - 1, m) commanded."""
    error: list[float | None]
    """(n - 1,) |h_hat - h| of the step that ended at each tick."""


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What one run came to; it depends on the job and the code alone."""

    job: Job
    lost: str | None
    """Why the true motion could not be followed to the end."""
    episodes: list[Performance]
    """Those that could be followed to their end; of set-points by turns the cycles."""
    performance: Performance
    """Of all that could be followed."""
    iteration_limit_ticks: int
    soft_ticks: int
    fallback_ticks: int
    weights_adopted: int
    error_first: float | None
    error_last: float | None
    """Mean prediction error in the first and the last second."""
    traces: Traces | None
    lemma: Lemma | None

    @property
    def kept(self) -> bool:
        """All constraints, at all samples, on the true plant."""
        return self.lost is None and self.performance.constraint_violations == 0


def work(job: Job, key: str, folder: Path, detail: bool, logs: Sequence[Path]) -> None:
    """Run `job` and write `folder`/`key`.json, and its logs.

    Raises:
        ConfigError: the job's configuration admits no controller.
        OSError: something else than a file has the name of a log.
    """
    rests = None if job.set_points is None else _rests(job, job.set_points)
    outcome = _outcome(job)
    for log in logs:
        require_regular(log)
        partial = log.with_suffix(".partial")
        partial.unlink(missing_ok=True)
        save(outcome.run, partial)
        partial.replace(log)
    write_whole(folder / f"{key}.json", msgspec.json.encode(_record(job, outcome, rests, detail)))


def _record(job: Job, outcome: Outcome, rests: Rests | None, detail: bool) -> Record:
    run = outcome.run
    summary = summarise(run)
    return Record(
        job=job,
        lost=outcome.lost,
        episodes=summary.episodes[: outcome.episodes] if rests is None else _cycles(run, job, rests),
        performance=Performance(**{name: getattr(summary, name) for name in Performance.__struct_fields__}),
        iteration_limit_ticks=summary.iteration_limit_ticks,
        soft_ticks=summary.soft_ticks,
        fallback_ticks=summary.fallback_ticks,
        weights_adopted=summary.weights_adopted,
        error_first=summary.prediction_error.first_second,
        error_last=summary.prediction_error.last_second,
        traces=_traces(run) if detail else None,
        lemma=_lemma(run, job.config) if detail else None,
    )


def _outcome(job: Job) -> Outcome:
    if job.set_points is None:
        return follow(job.config, job.steps, job.faults, episodes=job.episodes)
    asked = wave.reference(job.set_points, job.steps * job.config.period, job.episodes)
    return follow(job.config, job.steps * job.episodes, job.faults, set_points=asked)


def _cycles(run: Run, job: Job, rests: Rests) -> list[Performance]:
    """Of each that could be followed to its end: dx and du are from where the true plant rests at the set-points."""
    plant, truth = plant_of(run), true_plant_of(job.config, get_plant, get_truth)
    motion, (x, u) = trajectory(run, plant), rests
    outputs = msgspec.structs.replace(job.config.reference, outputs=list(job.set_points or {}))
    config = msgspec.structs.replace(job.config, reference=outputs)
    firsts = range(0, len(motion.step) - job.steps, job.steps)
    parts = [motion.part(first, first + job.steps) for first in firsts]
    goal = np.append(x, x[-1:], axis=0)
    return [performance(msgspec.structs.replace(part, goal=goal), plant, config, truth, u) for part in parts]


def _rests(job: Job, values: wave.Values) -> Rests:
    true = true_motion(true_plant_of(job.config, get_plant, get_truth))
    try:
        return wave.rests(values, job.steps, true, build_plant(job.config), job.config.period)
    except PlantError as error:
        raise ConfigError(f"set_points: {error}") from error


def _traces(run: Run) -> Traces:
    plant = plant_of(run)
    x = trajectory(run, plant).x[:, list(plant.performance)]
    return Traces(
        x=x.tolist(),
        u=[result.u for result in run.results],
        error=[result.prediction_error for result in run.results],
    )


def _lemma(run: Run, config: Config) -> Lemma | None:
    if config.controller.oracle != "dnn":
        return None
    return measure(run, build_network_oracle(config, build_model(config)))


def read(path: Path, detail: bool) -> Record | None:
    """A finished run; None where there is none, or not all that is wanted of it."""
    try:
        found = msgspec.json.decode(read_regular(path), type=Record)
    except (OSError, msgspec.DecodeError):
        return None
    return found if found.traces is not None or not detail else None
