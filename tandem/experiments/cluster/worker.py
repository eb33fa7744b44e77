"""What runs on a worker: it takes the client's files, says what it is, and makes runs in child processes."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

import msgspec
from distributed import get_worker

from node_runtime import provenance
from tandem.experiments.cluster.bundle import Bundle, moved, unpack
from tandem.experiments.study.isolated import Children, Failure, Limits, Unwanted
from tandem.experiments.study.plan import PACKAGES, code_version
from tandem.experiments.study.work import Done, Task, work

NEEDED = ("torch", "mcap", "zstandard", "matplotlib", "jinja2")
"""Packages of the extra `experiment`."""
PREPARING = Limits(seconds=120.0)


class Facts(msgspec.Struct, frozen=True, kw_only=True):
    """What a worker is."""

    code: str
    """`code_version`, of code and packages."""
    versions: dict[str, str]
    missing: list[str]
    """Packages of the extra `experiment` that it does not have."""


def prepare(bundle: Bundle) -> Facts | Failure:
    """Put the client's files on this worker, and say what it is."""
    root = _root(bundle.sha256)
    unpack(bundle, root)
    with _children(root).one() as child:
        facts: Facts | Failure = child.call(facts_here, limits=PREPARING)
    return facts


def facts_here() -> Facts:
    """Facts of this process. A worker may have been started before its packages were changed, so a child answers."""
    return Facts(
        code=code_version(),
        versions=provenance.versions(PACKAGES),
        missing=[package for package in NEEDED if find_spec(package) is None],
    )


def perform(task: Task, bundle: str) -> Done | Failure:
    """Make one run, until it is cancelled. bundle: the hash of the client's files."""
    worker, root = get_worker(), _root(bundle)
    key = worker.get_current_task()

    def wanted() -> bool:
        state = worker.state.tasks.get(key)
        return state is not None and state.state == "executing"

    try:
        with _children(root).one() as child:
            config = moved(task.job.config, root)
            answer: Done | Failure = child.call(work, task, config, limits=task.limits, wanted=wanted)
    except Unwanted:
        return Failure(kind="crash", text="cancelled", traceback="")
    if isinstance(answer, Failure):
        return msgspec.structs.replace(answer, where=str(worker.name))
    return answer


def _root(bundle: str) -> Path:
    return Path(get_worker().local_directory) / "tandem" / bundle[:24]


@cache
def _children(root: Path) -> Children:
    """Of this worker process, for one client's files: what a child has imported from them stays in it."""
    return Children()
