"""Make several runs at a time, in processes of their own."""

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
    """One planned run."""

    fault: str
    """Name of the fault; empty for a run without one."""
    stage: Stage
    index: int
    seed: int
    out: Path
    """The suite's folder."""
    settings: tuple[str, ...]


class Workers:
    """Make runs, `jobs` at a time, in the given order."""

    def __init__(self, pool: ProcessPoolExecutor, keep: Callable[[Outcome], None]):
        self._pool, self._keep = pool, keep

    def begin(self, task: Task) -> Future[Outcome]:
        """Wait for the run's outcome and store it."""
        future = self._pool.submit(_make, task)
        future.add_done_callback(self._done)
        return future

    def _done(self, future: Future[Outcome]) -> None:
        if not future.cancelled() and future.exception() is None:
            self._keep(future.result())


@contextmanager
def workers(jobs: int, keep: Callable[[Outcome], None]) -> Iterator[Workers]:
    """Run `jobs` processes for the length of a `with`; on an early exit each first cleans up its run."""
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
    """Handle Ctrl-C in the worker; it must not interrupt the clean-up."""
    # Log lines of the run's own bus about dead routers and bad messages are expected here.
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
