"""Runs on the workers of a Dask scheduler: a workplace for `run_all` over `dask.distributed`.

A worker gets runs if it has the client's code and packages. If it dies, Dask gives its run to another worker. If the
scheduler dies, unfinished runs are lost and repeated when it is back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import pickle
from collections.abc import Callable
from concurrent.futures import Future
from time import monotonic, sleep
from typing import Any

from distributed import Client
from distributed.client import Future as DaskFuture
from distributed.security import Security

from node_runtime import provenance
from tandem.experiments.cluster.bundle import Bundle
from tandem.experiments.cluster.making import Facts
from tandem.experiments.cluster.worker import perform, prepare
from tandem.experiments.study.isolated import Failure
from tandem.experiments.study.plan import PACKAGES, code_version
from tandem.experiments.study.runner import Answer, Lost, RunnerError
from tandem.experiments.study.work import Task

CONNECT_S = 10.0
PATIENCE_S = 300.0
"""Seconds for which a sweep waits for a lost scheduler, or for a worker."""
LOOK_S = 1.0
"""Interval between two counts of the workers, seconds."""
KEPT = "the finished runs are kept; the same command continues from there"


class Cluster:
    """Workplace of the workers of one scheduler.

    Args:
        address: as `address.checked` returns it.
        bundle: the files that the runs need.
        notice: gets a sentence for each worker that joins, leaves or is refused.
        patience: seconds without a scheduler or a usable worker until the sweep ends.

    Raises:
        RunnerError: no scheduler answers there.
    """

    def __init__(
        self,
        address: str,
        bundle: Bundle,
        notice: Callable[[str], None] = lambda text: None,
        patience: float = PATIENCE_S,
    ):
        # `notice` reports events, so Dask's own loggers are silenced.
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        self._address, self._bundle, self._notice, self._patience = address, bundle, notice, patience
        self._accepted: dict[str, int] = {}
        """Number of threads, by address."""
        self._folders: dict[str, str] = {}
        """Folder of each known worker, by address. Another folder means that the worker was restarted."""
        self._preparing: dict[str, DaskFuture] = {}
        self._refused: dict[str, str] = {}
        self._under_way: dict[DaskFuture, tuple[Future[Answer], set[str]]] = {}
        self._looked, self._worked = 0.0, monotonic()
        _require_certificates(address)
        try:
            self._client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, RuntimeError) as error:
            raise RunnerError(
                f"no Dask scheduler answers at {address}: check the address, and that `dask scheduler` "
                f"runs there ({error})"
            ) from error

    def room(self) -> int:
        """Return two runs for each thread of a worker, so that no thread waits for the next run."""
        now = monotonic()
        if now - self._looked >= LOOK_S or not self._accepted:
            self._looked = now
            self._look()
        if self._accepted:
            self._worked = now
        elif now - self._worked > self._patience:
            refused = "; ".join(self._refused.values())
            raise RunnerError(
                f"no worker of {self._address} could be used for {self._patience:.0f} s"
                f"{f' ({refused})' if refused else ''}; {KEPT}"
            )
        return 2 * sum(self._accepted.values())

    def submit(self, task: Task) -> Future[Answer]:
        future: Future[Answer] = Future()
        # A run that a worker may have begun cannot be withdrawn.
        future.set_running_or_notify_cancel()
        workers = list(self._accepted)
        try:
            sent = self._client.submit(
                perform,
                *(pickle.dumps(task), task.limits, self._bundle.sha256),
                pure=False,
                workers=workers,
                allow_other_workers=False,
            )
        except (OSError, RuntimeError) as error:
            future.set_exception(Lost(f"the scheduler is gone: {error}"))
            return future
        self._under_way[sent] = future, set(workers)
        sent.add_done_callback(self._done)
        return future

    def close(self) -> None:
        """Cancel all unfinished runs, and leave the cluster unchanged."""
        with contextlib.suppress(OSError, RuntimeError, asyncio.CancelledError):
            if self._client.status == "running":
                self._client.cancel(list(self._under_way), force=True)
            self._client.close(timeout=5)

    def _done(self, sent: DaskFuture) -> None:
        """Handle a finished run, in a thread of Dask."""
        future, _workers = self._under_way.pop(sent, (None, None))
        if future is None:
            return
        try:
            answer = sent.result(timeout=60)
            future.set_result(answer if isinstance(answer, Failure) else pickle.loads(answer))
        except (asyncio.CancelledError, TimeoutError) as error:
            future.set_exception(Lost(str(error)))
        except Exception as error:  # noqa: BLE001 - of Dask, a worker or what either could not unpickle
            future.set_result(Failure(kind="crash", text=f"{type(error).__name__}: {error}", traceback=""))

    # -- workers ---------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Update the list of workers: prepare new ones and forget lost ones."""
        there = self._workers()
        folders = {address: info["local_directory"] for address, info in there.items()}
        new = {address for address in folders if folders[address] != self._folders.get(address)}
        for address in [address for address in self._accepted if address not in there or address in new]:
            del self._accepted[address]
            self._notice(f"worker {address} is lost; {len(self._accepted)} left")
        for known in (self._refused, self._preparing):
            for address in [address for address in known if address not in there or address in new]:
                del known[address]
        self._folders = folders
        for address in there.keys() - self._accepted.keys() - self._refused.keys() - self._preparing.keys():
            self._preparing[address] = self._client.submit(
                prepare, self._bundle, pure=False, workers=[address], allow_other_workers=False
            )
        for address, future in list(self._preparing.items()):
            if future.done():
                del self._preparing[address]
                self._decide(address, there[address], future)
        self._drop_stranded()

    def _workers(self) -> dict[str, dict[str, Any]]:
        """Return the workers by address; none while the scheduler is lost. Raises `RunnerError` if it stays lost."""
        gone, said = monotonic(), False
        while monotonic() - gone < self._patience:
            found = self._ask()
            if found is not None:
                if said:
                    self._notice("the scheduler is back")
                return found
            if not said:
                said = True
                self._notice(f"the scheduler at {self._address} is lost; waiting for it")
            sleep(LOOK_S)
        raise RunnerError(f"the scheduler at {self._address} was lost for {self._patience:.0f} s; {KEPT}")

    def _ask(self) -> dict[str, dict[str, Any]] | None:
        """Return the workers that the scheduler reports now; None if it does not answer."""
        try:
            # A client tries to reconnect for some seconds, and then closes.
            if self._client.status != "running":
                self._lose_all()
            if self._client.status == "closed":
                self._client = Client(self._address, timeout=CONNECT_S, set_as_default=False)
            if self._client.status != "running":
                return None
            workers: dict[str, dict[str, Any]] = self._client.sync(
                self._client.scheduler.identity, n_workers=-1, callback_timeout=CONNECT_S
            )["workers"]
        except (OSError, RuntimeError):
            return None
        return workers

    def _lose_all(self) -> None:
        """Let all runs be submitted again."""
        for sent in list(self._under_way):
            future, _workers = self._under_way.pop(sent, (None, None))
            if future is not None:
                future.set_exception(Lost("the scheduler is gone"))
        self._folders = {}

    def _decide(self, address: str, info: dict[str, Any], future: DaskFuture) -> None:
        name = f"worker {info['name']}" if info["name"] == address else f"worker {info['name']} ({address})"
        try:
            why = why_not(future.result(timeout=60))
        except asyncio.CancelledError:
            return
        except Exception as error:  # noqa: BLE001 - of a worker that lacks Tandem or is otherwise not like this process
            why = f"Tandem does not run on it: {type(error).__name__}: {error}"
        if why is None:
            self._accepted[address] = info["nthreads"]
            self._notice(f"{name} has joined, {info['nthreads']} runs at a time")
        else:
            self._refused[address] = f"{name} is refused: {why}"
            self._notice(self._refused[address])

    def _drop_stranded(self) -> None:
        """Let runs be submitted again if none of their intended workers is left."""
        for sent, (_future, workers) in list(self._under_way.items()):
            if not workers & self._accepted.keys():
                sent.cancel(force=True)


def why_not(facts: Facts | Failure) -> str | None:
    """Return why a worker must not make runs; None if it has the code and the packages of this process."""
    if isinstance(facts, Failure):
        return f"Tandem does not run on it: {facts.text}"
    ours = provenance.versions(PACKAGES)
    other = [
        f"{name} {facts.versions.get(name) or 'is missing'}, here {ours.get(name) or 'none'}"
        for name in sorted(ours.keys() | facts.versions.keys())
        if facts.versions.get(name) != ours.get(name)
    ]
    other += [f"{name} is missing" for name in facts.missing if name not in ours or name in facts.versions]
    if other:
        return f"other packages ({'; '.join(other)})"
    if facts.code != code_version():
        return "the same version of Tandem with other code; install the same wheel"
    return None


def _require_certificates(address: str) -> None:
    """Raises `RunnerError` if the address needs certificates and Dask's configuration has no usable ones."""
    if not address.startswith("tls"):
        return
    why = "distributed.comm.tls has no ca-file"
    try:
        if Security().get_connection_args("client").get("ssl_context") is not None:
            return
    except (OSError, ValueError) as error:  # a file is missing, or is not a certificate
        why = str(error)
    raise RunnerError(
        f"{address} needs certificates, and Dask's configuration has none that can be used ({why}): name them in "
        '~/.config/dask/tls.yaml ("Sweep on a cluster" in the documentation)'
    )
