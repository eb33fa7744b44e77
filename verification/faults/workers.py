"""Runs in processes of their own, several at a time."""

from __future__ import annotations

import logging
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from verification.faults.catalogue import BY_NAME, Stage
from verification.faults.suite import Outcome, run


@dataclass(frozen=True)
class Task:
    """One run that is to be made."""

    fault: str
    """Its name; empty: without one."""
    stage: Stage
    index: int
    seed: int
    out: Path
    """The suite's folder."""
    settings: tuple[str, ...]


class Workers:
    """Makes runs, `jobs` at a time, in the order in which they were given."""

    def __init__(self, pool: ProcessPoolExecutor, keep: Callable[[Outcome], None]):
        self._pool, self._keep = pool, keep

    def begin(self, task: Task) -> Future[Outcome]:
        """The run's outcome, when there is one; it is kept then, whoever waits for it."""
        future = self._pool.submit(_make, task)
        future.add_done_callback(self._done)
        return future

    def _done(self, future: Future[Outcome]) -> None:
        if not future.cancelled() and future.exception() is None:
            self._keep(future.result())


@contextmanager
def workers(jobs: int, keep: Callable[[Outcome], None]) -> Iterator[Workers]:
    """`jobs` processes for the length of a `with`; when it is left early, each first clears away its run."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, _prepare)
    try:
        yield Workers(pool, keep)
    except BaseException:
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """In the worker. Ctrl-C reaches it, too, and must not come again while it clears away."""
    # What the run's own bus has to say of dead routers and bad messages is no news here.
    logging.disable(logging.WARNING)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupted)


def _interrupted(_number: int, _frame: object) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    raise SystemExit(130)


def _make(task: Task) -> Outcome:
    fault = BY_NAME[task.fault] if task.fault else None
    return run(task.stage, fault, task.index, task.seed, task.out, list(task.settings))
