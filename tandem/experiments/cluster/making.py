"""Functions of a worker's child process. They contain their imports, because the worker itself imports no science."""

from __future__ import annotations

import pickle
from importlib.util import find_spec
from pathlib import Path

import msgspec

NEEDED = ("torch", "mcap", "zstandard", "matplotlib", "jinja2")
"""Packages of the extra `experiment`."""


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """Facts about a worker."""

    code: str
    """`code_version` of code and packages."""
    versions: dict[str, str]
    missing: list[str]
    """Packages of the extra `experiment` that it does not have."""


def facts() -> Facts:
    """Return the facts of this process. A worker may be older than its packages, but a child process is new."""
    from node_runtime import provenance
    from tandem.experiments.study.plan import PACKAGES, code_version

    return Facts(
        code=code_version(),
        versions=provenance.versions(PACKAGES),
        missing=[package for package in NEEDED if find_spec(package) is None],
    )


def make(task: bytes, root: Path) -> bytes:
    """Run a pickled `Task` and return its pickled `Done`. root: folder of the client's files."""
    from tandem.experiments.cluster.bundle import moved
    from tandem.experiments.study.work import Task, work

    asked: Task = pickle.loads(task)
    return pickle.dumps(work(asked, moved(asked.job.config, root)))
