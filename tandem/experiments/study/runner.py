"""Makes the missing runs, on this machine's cores or on another workplace.

A run is the same in any process, so neither the number of processes nor an interruption changes a figure.
"""

from __future__ import annotations

import hashlib
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, as_completed, wait
from pathlib import Path
from typing import NamedTuple, Protocol

from node_runtime.whole_file import write_whole
from tandem.experiments.study.isolated import ORDINARY, Children, Failure, Limits
from tandem.experiments.study.plan import Job, RowPlan, code_version, files_read
from tandem.experiments.study.work import Done, Record, Task, read, work

Progress = Callable[[int, int], None]
"""Called with the number of finished items and the total."""
Answer = Done | Failure

TRIES = 3
"""Number of attempts if the process of a run dies. A run that raises or exceeds a limit is not repeated."""
POLL_S = 0.5
LONGEST_NAME = 160
"""Largest number of letters of a case in a file name, which may have 255 in all."""


class RunnerError(RuntimeError):
    """The runs cannot continue; the text gives the reason and a remedy."""


class Lost(Exception):
    """A run was not made for an external reason, such as a lost worker."""


class Workplace(Protocol):
    """A place that makes runs: this machine, or a cluster."""

    def room(self) -> int:
        """Return the number of runs to submit at a time, so that no worker waits. Raises `RunnerError`."""

    def submit(self, task: Task) -> Future[Answer]:
        """Submit a run. The future's result raises `Lost` if the run must be submitted again."""

    def close(self) -> None:
        """Stop all unfinished runs."""


class Processes:
    """Workplace of some processes on this machine."""

    def __init__(self, count: int):
        self._children, self._pool, self._count = Children(), ThreadPoolExecutor(count), count

    def room(self) -> int:
        return 2 * self._count

    def submit(self, task: Task) -> Future[Answer]:
        return self._pool.submit(self._make, task)

    def _make(self, task: Task) -> Answer:
        with self._children.one() as child:
            answer: Answer = child.call(work, task, limits=task.limits)
            return answer

    def close(self) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._children.kill()
        self._pool.shutdown()


class Want(NamedTuple):
    """One job, and the requested results beyond its figures."""

    job: Job
    detail: bool
    logs: tuple[Path, ...]
    """Log files of the job. Two cases may share a job, and each has its own log."""


class Made(NamedTuple):
    """Records, by key of the job."""

    records: dict[str, Record]
    failures: dict[str, Failure]


def wanted(plans: list[RowPlan], detailed: set[str], logs: Path) -> dict[str, Want]:
    """Return every job once, including floors, by key. `detailed`: groups whose pictures show traces."""
    wants: dict[str, Want] = {}

    def want(job: Job, detail: bool, *logs: Path) -> None:
        before = wants.get(job.key, Want(job, False, ()))
        wants[job.key] = Want(job, detail or before.detail, (*before.logs, *logs))

    for plan in plans:
        case = plan.case
        name = f"{file_name(case.name)}-seed{plan.job.config.seed}.mcap"
        want(plan.job, case.group in detailed, *([logs / name] if case.log and plan.x0 is None else []))
        want(plan.floor, False)
    return wants


def run_all(
    wants: dict[str, Want],
    folder: Path,
    workplace: Workplace,
    progress: Progress = lambda done, total: None,
    limits: Limits = ORDINARY,
) -> Made:
    """Return the record of every job, or its failure. Records that are already in `folder` are used.

    Raises:
        RunnerError: no workplace is left.
        OSError: a result cannot be written.
        KeyboardInterrupt: after the unfinished runs have ended and were kept; at once for a second signal.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.glob(".*.new"):  # of a process that was killed
        leftover.unlink(missing_ok=True)
    missing = [
        key
        for key, want in wants.items()
        if read(folder / f"{key}.json", want.detail) is None or not all(log.is_file() for log in want.logs)
    ]
    # Long runs come first, so that the end of the sweep uses all cores.
    missing.sort(key=lambda key: _effort(wants[key].job), reverse=True)
    sweep = _Sweep(wants, folder, workplace, progress, limits, deque(missing))
    try:
        sweep.run()
    except KeyboardInterrupt:
        sweep.finish()
        raise
    records = {}
    for key, want in wants.items():
        if key in sweep.failures:
            continue
        record = read(folder / f"{key}.json", want.detail)
        if record is None:
            raise RunnerError(f"{folder}: {key}.json was deleted or damaged during the run; run again")
        records[key] = record
    return Made(records, sweep.failures)


class _Sweep:
    """The runs of one call of `run_all`."""

    def __init__(
        self,
        wants: dict[str, Want],
        folder: Path,
        workplace: Workplace,
        progress: Progress,
        limits: Limits,
        missing: deque[str],
    ):
        self.wants, self.folder, self.workplace, self.limits = wants, folder, workplace, limits
        self.missing, self.progress = missing, progress
        self.done = len(wants) - len(missing)
        self.under_way: dict[Future[Answer], str] = {}
        self.tries: Counter[str] = Counter()
        self.failures: dict[str, Failure] = {}
        progress(self.done, len(wants))

    def run(self) -> None:
        while self.missing or self.under_way:
            room = self.workplace.room() - len(self.under_way)
            for _ in range(min(room, len(self.missing))):
                key = self.missing.popleft()
                self.under_way[self.workplace.submit(self._task(key))] = key
            if self.under_way:
                self._keep(*wait(self.under_way, POLL_S, FIRST_COMPLETED).done)
            else:
                time.sleep(POLL_S)

    def finish(self) -> None:
        """Finish the runs in progress, and begin no others."""
        for future in list(self.under_way):
            if future.cancel():
                del self.under_way[future]
        for future in as_completed(list(self.under_way)):
            self._keep(future)

    def _task(self, key: str) -> Task:
        want = self.wants[key]
        if want.job.key != key:
            raise RunnerError(
                "a file that the configuration names was changed while the experiment ran; the finished runs are kept, "
                "and the same command makes those again that depend on it"
            )
        return Task(
            job=want.job,
            detail=want.detail,
            log=bool(want.logs),
            files=files_read(want.job.config),
            limits=self.limits,
        )

    def _keep(self, *done: Future[Answer]) -> None:
        for future in done:
            key = self.under_way.pop(future)
            try:
                answer = future.result()
            except Lost:
                self.missing.append(key)
                continue
            if isinstance(answer, Failure) and answer.kind == "crash":
                self.tries[key] += 1
                if self.tries[key] < TRIES:
                    self.missing.append(key)
                    continue
            if isinstance(answer, Done):
                self._write(key, answer)
            else:
                self.failures[key] = answer
            self.done += 1
            self.progress(self.done, len(self.wants))

    def _write(self, key: str, made: Done) -> None:
        if made.code != code_version():
            raise RunnerError(
                "Tandem's code or a package was changed while the experiment ran; the finished runs are kept, and the "
                "same command repeats those that depend on it"
            )
        for log in self.wants[key].logs:
            write_whole(log, made.log or b"")
        write_whole(self.folder / f"{key}.json", made.record)


def _effort(job: Job) -> float:
    learning = 5.0 if job.config.controller.oracle == "dnn" else 1.0
    return job.steps * job.episodes * job.config.controller.horizon * learning


def file_name(name: str) -> str:
    """Return a file name. Special characters are replaced, and different names still give different files."""
    clean = "".join(c if c.isascii() and (c.isalnum() or c in "-_=.") else "-" for c in name)[:LONGEST_NAME]
    return clean if clean == name else f"{clean}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
