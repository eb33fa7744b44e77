"""Plans the runs of the cases. Each run is made once for all its rows, under a hash of its settings and code."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec

from node_runtime import provenance
from node_runtime.config.plant import files_of
from node_runtime.config.sections import Config
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.study.declaration import Resolved

CODE = (
    "network_model",
    "lbmpc",
    "protocol",
    "controller_node",
    "trainer_node",
    "plant_sim",
    "run_log/reporting/motion.py",
    "run_log/reporting/between_samples.py",
    "run_log/reporting/performance.py",
    "run_log/reporting/summary.py",
    "node_runtime/config/plant.py",
    "tandem/operating",
    "tandem/experiments/simulation",
    "tandem/experiments/study/lemma.py",
    "tandem/experiments/study/work.py",
)
"""Folders and files."""
PACKAGES = (*provenance.SCIENCE, "torch")
"""Packages on which a result depends, beside the code."""


class Job(msgspec.Struct, frozen=True, kw_only=True):
    """One run."""

    config: Config
    steps: int
    episodes: int
    faults: Faults
    set_points: dict[str, list[float]] | None = None

    @property
    def key(self) -> str:
        """Hash of everything that the result depends on: settings, code, and the user's own files."""
        files = msgspec.json.encode(files_read(self.config))
        return hashlib.sha256(msgspec.json.encode(self) + files + code_version().encode()).hexdigest()[:24]


def files_read(config: Config) -> dict[str, str]:
    """Return the sha256 of the files that a run of this configuration reads, by key: code, and certified sets."""
    found, sets = files_of(config), config.controller.sets
    if config.controller.tightening == "invariant" and sets is not None:
        with suppress(OSError):
            found["controller.sets"] = hashlib.sha256(Path(sets).read_bytes()).hexdigest()
    return found


class RowPlan(NamedTuple):
    """One row of the results, the run behind it, and the run that is its floor."""

    case: Resolved
    seed: int
    x0: list[float] | None
    job: Job
    floor: Job


def rows(cases: list[Resolved]) -> Iterator[RowPlan]:
    """Return the rows of every case, seed and initial state, in the order of the file."""
    for case in cases:
        for x0 in case.x0s:
            for seed in case.seeds:
                config = case.config_of(seed, x0)
                yield RowPlan(case, seed, x0, _job(config, case), _floor(config, case))


def _job(config: Config, case: Resolved) -> Job:
    faults = case.faults
    if config.controller.oracle != "dnn":
        faults = msgspec.structs.replace(faults, training_seconds=0.0, trainer_dies_at=None)
    return Job(
        config=_what_counts(config),
        steps=case.steps,
        episodes=case.episodes,
        faults=faults,
        set_points=case.set_points,
    )


def _floor(config: Config, case: Resolved) -> Job:
    """Return the same run with the true h, which follows a drifting plant."""
    controller = msgspec.structs.replace(config.controller, oracle="perfect")
    return _job(msgspec.structs.replace(config, controller=controller), case)


def _what_counts(config: Config) -> Config:
    """Return the configuration in normal form: unused sections and seeds have their defaults."""
    unread, oracle = ["name", "bus", "log", "realtime"], config.controller.oracle
    if oracle != "constant":
        unread.append("constant")
    if oracle != "l2nw":
        unread.append("l2nw")
    if oracle != "dnn":
        unread += ["network", "adaptation", "trainer"]
        if not config.plant.sensors.random:
            unread.append("seed")
    default = Config()
    return msgspec.structs.replace(config, **{name: getattr(default, name) for name in unread})


@cache
def code_version() -> str:
    """Hash of the code and the libraries that a result depends on."""
    digest = hashlib.sha256()
    root = Path(__file__).resolve().parents[3]
    for name in CODE:
        path = root / name
        files = [one for one in sorted(path.rglob("*")) if one.suffix in (".py", ".c")]
        for file in files or [path]:
            digest.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes() + b"\0")
    for package, version in provenance.versions(PACKAGES).items():
        digest.update(f"{package} {version}\0".encode())
    return digest.hexdigest()
