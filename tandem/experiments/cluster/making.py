"""What a worker's child process does. The worker itself imports no science, so imports stand in the functions."""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from pathlib import Path

import msgspec

NEEDED = ("torch", "mcap", "zstandard", "matplotlib", "jinja2")
"""Packages of the extra `experiment`."""


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker is."""

    code: str
    """`code_version`, of code and packages."""
    versions: dict[str, str]
    missing: list[str]
    """Packages of the extra `experiment` that it does not have."""


def facts() -> Facts:
    """Facts of this process. A worker may have been started before its packages were changed; a child is new."""
    from node_runtime import provenance
    from tandem.experiments.study.plan import PACKAGES, code_version

    return Facts(
        code=code_version(),
        versions=provenance.versions(PACKAGES),
        missing=[package for package in NEEDED if find_spec(package) is None],
    )


def make(task: bytes, root: Path) -> bytes:
    """The `Done` of a `Task`, both pickled. root: where the client's files are."""
    from tandem.experiments.cluster.bundle import moved
    from tandem.experiments.study.work import Task, work

    asked: Task = pickle.loads(task)
    return pickle.dumps(work(asked, moved(asked.job.config, root)))
