"""Run faults: choose moment and seed, and keep the outcomes. One run is one line of a file, so a suite can continue."""

from __future__ import annotations

import shutil
import zlib
from pathlib import Path

import msgspec
import numpy as np

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from node_runtime.realtime import clock
from node_runtime.realtime.scheduling import READER_PRIORITY, punctual
from run_log.errors import LogError
from tandem.operating.commander import ask
from tandem.operating.set_points import trajectory
from verification.faults.catalogue import Fault, Stage
from verification.faults.evaluation import evaluate
from verification.faults.facts import Facts
from verification.faults.processes.rig import Place, Rig, RigError
from verification.faults.processes.scenes import nothing

EARLIEST_S = 0.3
"""Seconds after the first command; earlier samples do not count."""
LED_S = 60.0
"""Seconds in which a controller must answer a reference."""
SETTLED_S = 4.0
"""The fault comes within so many seconds after the beginning, where the plant moves most."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """One run, as stored in the file."""

    fault: str
    """Empty: without one."""
    stage: str
    index: int
    seed: int
    at: float
    """Moment of the fault, in seconds after the first command."""
    wall_s: float
    facts: Facts | None
    error: str = ""
    """Reason why there are no facts."""
    not_held: list[str] = []

    def folder(self, out: Path) -> Path:
        """Folder of the run's files, below the suite's folder."""
        return folder_of(out, self.fault or self.stage, self.index)


def moment(fault: Fault, index: int, seed: int) -> float:
    """Return the moment of the fault in its `index`-th run, in seconds after the first command."""
    rng = np.random.default_rng([seed, zlib.crc32(fault.name.encode()), index])
    return float(rng.uniform(EARLIEST_S, SETTLED_S))


def folder_of(out: Path, name: str, index: int) -> Path:
    """Return the folder of one run of a fault or, without a fault, of a scene."""
    return out / f"{name}-{index}".replace(" ", "-").replace("/", "-").replace(":", "")


def run(stage: Stage, fault: Fault | None, index: int, seed: int, out: Path, settings: list[str]) -> Outcome:
    """Make one run, with or without a fault, in a folder of its own below `out`."""
    folder = folder_of(out, stage.name if fault is None else fault.name, index)
    began = clock.now()
    at = 0.0 if fault is None else moment(fault, index, seed)
    config = override(Config(seed=seed + index), [*stage.settings, *settings])
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    facts, error = None, ""
    try:
        facts = _live(stage, fault, at, config, folder)
    except (RigError, LogError) as problem:
        error = str(problem)
    return Outcome(
        fault="" if fault is None else fault.name,
        stage=stage.name,
        index=index,
        seed=seed,
        at=at,
        wall_s=clock.now() - began,
        facts=facts,
        error=error,
    )


def _live(stage: Stage, fault: Fault | None, at: float, config: Config, folder: Path) -> Facts:
    scene = nothing if fault is None else fault.scene
    with scene(folder) as around:
        places: dict[str, Place] = {"plant": stage.plant, "trainer": stage.trainer}
        rig = Rig(folder, config, places, around=around, seed=config.seed)
        with punctual(min(READER_PRIORITY, config.realtime.priority), silent=True):
            extra = _hurt(rig, stage, fault, at)
        # While the log's disk still exists.
        return evaluate(rig, stage.seconds, extra)


def _hurt(rig: Rig, stage: Stage, fault: Fault | None, at: float) -> dict[str, float]:
    """Make the run itself, from the start of its processes to their end; return what the fault measured."""
    extra: dict[str, float] = {}
    with rig:
        assert rig.first_command is not None
        if stage.set_points:
            times, values = zip(*stage.set_points, strict=True)
            if not ask(rig.config, trajectory(times, {"y": values}), LED_S):
                raise RigError("no controller took the reference")
        if fault is not None:
            rig.run_until(rig.first_command + at)
            extra = fault.inflict(rig, rig.config.seed) or {}
            rig.run_for(fault.after)
        rig.run_until(rig.first_command + stage.seconds)
        rig.end()
    return extra


def judged(outcome: Outcome, fault: Fault, calm: Facts) -> Outcome:
    """The outcome with the checks that failed."""
    if outcome.facts is None:
        return msgspec.structs.replace(outcome, not_held=[outcome.error])
    found = [why for held in fault.holds if (why := held(outcome.facts, calm)) is not None]
    return msgspec.structs.replace(outcome, not_held=found)


class ResultsError(Exception):
    """The results of an earlier run cannot be continued; the text says why and what to do."""


class Results:
    """The file of outcomes; runs in it are not repeated."""

    def __init__(self, path: Path):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        if whole != text:
            # The suite was killed while it wrote a line.
            path.write_bytes(whole)
        decoder = msgspec.json.Decoder(Outcome)
        try:
            self.outcomes = [decoder.decode(line) for line in whole.splitlines()]
        except msgspec.ValidationError as error:
            raise ResultsError(
                f"{path} is of another version of the suite ({error}); begin again with --fresh"
            ) from None

    def find(self, fault: str, stage: str, index: int, seed: int) -> Outcome | None:
        for outcome in reversed(self.outcomes):
            if (outcome.fault, outcome.stage, outcome.index, outcome.seed) == (fault, stage, index, seed):
                return outcome
        return None

    def put(self, made: Outcome) -> None:
        """Store the outcome in the file, in place of an earlier one of the same run."""
        self.outcomes.append(made)
        with self.path.open("ab") as file:
            file.write(msgspec.json.encode(made) + b"\n")
