"""One run: its record and its log, as bytes. No file is written, because the caller may be on another machine."""

from __future__ import annotations

import tempfile
from pathlib import Path

import msgspec
import numpy as np

from controller_node.build import build_model, build_network_oracle, build_plant
from lbmpc.plants import PlantError, get_plant, get_truth, true_motion
from node_runtime.config.loading import to_json
from node_runtime.config.plant import true_plant_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from node_runtime.realtime.scheduling import one_blas_thread
from node_runtime.whole_file import read_regular
from protocol import codec, topics
from run_log.reporting.motion import trajectory
from run_log.reporting.performance import Performance, performance
from run_log.reporting.summary import summarise
from run_log.run import Entry, Run, plant_of
from run_log.writing.save import save
from tandem.experiments.simulation import wave
from tandem.experiments.simulation.lockstep import Outcome, follow
from tandem.experiments.study.isolated import ORDINARY, Limits
from tandem.experiments.study.lemma import Lemma, measure
from tandem.experiments.study.plan import Job, code_version, files_read

Rests = tuple[np.ndarray, np.ndarray]
"""Equilibria of the true plant at the set-points of each tick of a cycle, from `wave.rests`."""


class Traces(msgspec.Struct, frozen=True, kw_only=True):
    """Traces of n samples from the start."""

    x: list[list[float]]
    """(n, p) performance states, plant units."""
    u: list[list[float]]
    """(n - 1, m) commanded input."""
    error: list[float | None]
    """(n - 1,) |h_hat - h| of the step that ended at each tick."""


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one run. It depends only on the job and the code."""

    job: Job
    lost: str | None
    """Reason why the true motion could not be computed to the end."""
    episodes: list[Performance]
    """Figures of the complete episodes; for periodic set-points, of the complete cycles."""
    performance: Performance
    """Figures of the run, up to a loss of the plant."""
    iteration_limit_ticks: int
    soft_ticks: int
    fallback_ticks: int
    weights_adopted: int
    error_first: float | None
    error_last: float | None
    """Mean prediction error in the first and the last second."""
    traces: Traces | None
    lemma: Lemma | None
    arithmetic: str
    """Processor, BLAS kernels and compiler of the solver, on which the last digits depend."""

    @property
    def kept(self) -> bool:
        """Whether the true plant keeps all constraints at all samples."""
        return self.lost is None and self.performance.constraint_violations == 0


class Task(msgspec.Struct, frozen=True, kw_only=True):
    """One run to be made, and its requested results."""

    job: Job
    detail: bool
    """Whether to return the traces."""
    log: bool
    """Whether to return the MCAP log."""
    files: dict[str, str]
    """The sha256 of the files that its configuration names, by key, as `files_read` finds them."""
    limits: Limits = ORDINARY


class Done(msgspec.Struct, frozen=True, kw_only=True):
    """Results of a run."""

    record: bytes
    """A `Record`, as JSON."""
    log: bytes | None
    code: str
    """`code_version` of the process that ran it."""


def work(task: Task, config: Config | None = None) -> Done:
    """Make one run.

    Args:
        task: what to run.
        config: the task's configuration with local paths of its files; None: the paths are valid here.

    Raises:
        ConfigError: the configuration does not give a controller, or a named file differs from that of the client.
    """
    here = task.job if config is None else msgspec.structs.replace(task.job, config=config)
    with one_blas_thread():
        rests = None if here.set_points is None else _rests(here, here.set_points)
        outcome = _outcome(here)
        found = files_read(here.config)
        for key, sha256 in task.files.items():
            if found.get(key) != sha256:
                raise ConfigError(f"{key}: the named file is missing here or has other content")
        record = msgspec.structs.replace(_record(here, outcome, rests, task.detail), job=task.job)
    _rename(outcome.run, task.job.config)
    log = _log(outcome.run) if task.log else None
    return Done(record=msgspec.json.encode(record), log=log, code=code_version())


def _rename(run: Run, config: Config) -> None:
    """Replace local paths in the run by those of the client."""
    run.config = config
    for topic in topics.RUN_INFO.values():
        for i, entry in enumerate(run.entries(topic)):
            versions = dict(entry.message.versions)
            if "architecture" in versions:
                versions["architecture"] = config.network.architecture
            info = msgspec.structs.replace(entry.message, config=to_json(config), versions=versions)
            run.streams[topic.name][i] = Entry(entry.log_time, codec.encode(info), info)


def _log(run: Run) -> bytes:
    with tempfile.TemporaryDirectory(prefix="tandem-") as folder:
        path = Path(folder) / "run.mcap"
        save(run, path)
        return path.read_bytes()


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
        arithmetic=_arithmetic(run),
    )


def _outcome(job: Job) -> Outcome:
    if job.set_points is None:
        return follow(job.config, job.steps, job.faults, episodes=job.episodes)
    asked = wave.reference(job.set_points, job.steps * job.config.period, job.episodes)
    return follow(job.config, job.steps * job.episodes, job.faults, set_points=asked)


def _cycles(run: Run, job: Job, rests: Rests) -> list[Performance]:
    """Return the figures of each complete cycle, relative to the true plant's equilibria at the set-points."""
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


def _arithmetic(run: Run) -> str:
    (info,) = (info for info in run.run_infos if info.process == "controller")
    return "; ".join(info.versions[name] for name in ("processor", "blas", "kernels"))


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
    """Return a finished run; None if it is missing or lacks a requested result."""
    try:
        found = msgspec.json.decode(read_regular(path), type=Record)
    except (OSError, msgspec.DecodeError):
        return None
    return found if found.traces is not None or not detail else None
