"""What a Dask worker does: it takes the client's files, says what it is, and has its child processes make runs."""

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
    """Put the client's files on this worker, and say what it is."""
    root = _root(bundle.sha256)
    unpack(bundle, root)
    with _children(root).one() as child:
        found: Facts | Failure = child.call(facts, limits=PREPARING)
    return found


def perform(task: bytes, limits: Limits, bundle: str) -> bytes | Failure:
    """Make one run, unless it is cancelled meanwhile; a pickled `Task` comes in and a pickled `Done` goes out.

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
    """Of this worker process, for one client's files: what a child has imported from them stays in it."""
    return Children()
