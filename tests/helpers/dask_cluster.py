"""A Dask scheduler and workers on this machine's loopback, in separate processes, as `dask` starts them."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_S = 120.0
"""Limit in seconds that only ends a hang."""
QUIET = {"DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "error"}


class DaskCluster:
    """Processes by name; "scheduler" is one of them."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.port = free_port()
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start_scheduler(self) -> None:
        self._start("scheduler", ["scheduler", "--host", "127.0.0.1", "--port", str(self.port)])
        ends = time.monotonic() + START_S
        while time.monotonic() < ends:
            try:
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
            except OSError:
                assert self.processes["scheduler"].poll() is None, "the scheduler has ended"
                time.sleep(0.05)
            else:
                return
        raise AssertionError("the scheduler does not answer")

    def start_worker(self, name: str, python: str = sys.executable, nanny: bool = False) -> None:
        """python: interpreter of its environment."""
        options = ["--nthreads", "1", "--name", name, "--local-directory", str(self.folder / name)]
        self._start(name, ["worker", self.address, *options, *([] if nanny else ["--no-nanny"])], python)

    def kill(self, name: str) -> None:
        """Kill it with SIGKILL, as in a failure of its machine."""
        process = self.processes.pop(name)
        process.send_signal(signal.SIGKILL)
        process.wait()

    def stop(self) -> None:
        for process in self.processes.values():
            process.terminate()
        for process in self.processes.values():
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.processes.clear()

    def _start(self, name: str, arguments: list[str], python: str = sys.executable) -> None:
        with open(self.folder / f"{name}.log", "ab") as log:
            self.processes[name] = subprocess.Popen(
                [python, "-m", "dask", *arguments, "--no-dashboard"],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=os.environ | QUIET,
            )


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port: int = taken.getsockname()[1]
        return port


@contextmanager
def dask_cluster(folder: Path, *workers: str) -> Iterator[DaskCluster]:
    """Run a scheduler with these workers, one thread each."""
    folder.mkdir(parents=True, exist_ok=True)
    cluster = DaskCluster(folder)
    try:
        cluster.start_scheduler()
        for name in workers:
            cluster.start_worker(name)
        yield cluster
    finally:
        cluster.stop()
