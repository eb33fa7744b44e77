"""Functions of a Dask worker: it stores the client's files, reports its facts, and makes runs in child processes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import msgspec
from distributed import get_worker

from tandem.experiments.cluster.bundle import Bundle, unpack
from tandem.experiments.cluster.making import Facts, facts, make
from tandem.experiments.study.isolated import Children, Failure, Limits, Unwanted

PREPARING = Limits(seconds=300.0)


def prepare(bundle: Bundle) -> Facts | Failure:
    """Write the client's files on this worker, and return its facts."""
    root = _root(bundle.sha256)
    unpack(bundle, root)
    with _children(root).one() as child:
        found: Facts | Failure = child.call(facts, limits=PREPARING)
    return found


def perform(task: bytes, limits: Limits, bundle: str) -> bytes | Failure:
    """Make one run from a pickled `Task`, unless it is cancelled meanwhile; return a pickled `Done`.

    bundle: the hash of the client's files.
    """
    worker, root = get_worker(), _root(bundle)
    key = worker.get_current_task()

    def wanted() -> bool:
        state = worker.state.tasks.get(key)
        return state is not None and state.state == "executing"

    try:
        with _children(root).one() as child:
            done: bytes | Failure = child.call(make, task, root, limits=limits, wanted=wanted)
    except Unwanted:
        return Failure(kind="crash", text="cancelled", traceback="")
    if isinstance(done, Failure):
        return msgspec.structs.replace(done, where=str(worker.name))
    return done


def _root(bundle: str) -> Path:
    return Path(get_worker().local_directory) / "tandem" / bundle[:24]


@cache
def _children(root: Path) -> Children:
    """Return the child processes for one client's files. A child keeps the modules that it has imported from them."""
    return Children()
