"""A compose project for a test: up, down, kill a container's process, read its logs."""

from __future__ import annotations

import functools
import json
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

from tests.helpers.paths import ROOT

BASE = "python:3.11-slim"
KILL_ALL = "import os, signal; os.kill(-1, signal.SIGKILL)"


def compose_command() -> list[str]:
    """`docker compose` where there is one, else `docker-compose`."""
    plugin = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
    if plugin.returncode == 0:
        return ["docker", "compose"]
    if shutil.which("docker-compose"):
        return ["docker-compose"]
    raise RuntimeError("neither `docker compose` nor `docker-compose` is installed")


class Project:
    """One project of its own name; `down` leaves no container, network or volume of it."""

    def __init__(self, name: str, files: list[str], **environment: str):
        self.name = name
        self._command = [*compose_command(), "-p", name, *(part for file in files for part in ("-f", file))]
        # Where the storage driver copies whole images, creating a container can outlast docker-compose's usual 60 s.
        self._environment = {**os.environ, "COMPOSE_HTTP_TIMEOUT": "600", **environment}

    def compose(self, *arguments: str, timeout_s: float = 900.0) -> str:
        """Run a compose command; its standard output. Raises with all that it said when it fails."""
        ran = subprocess.run(
            [*self._command, *arguments],
            cwd=ROOT,
            env=self._environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
        if ran.returncode != 0:
            raise AssertionError(
                f"compose {' '.join(arguments)}: exit {ran.returncode}\n{ran.stdout}{ran.stderr}"
            )
        return ran.stdout

    def container(self, service: str) -> str:
        """The container's id."""
        return self.compose("ps", "-a", "-q", service).strip()

    def inspect(self, service: str) -> dict:
        return json.loads(docker("inspect", self.container(service)))[0]

    def services(self) -> list[str]:
        return self.compose("ps", "--services").split()

    def kill(self, service: str) -> None:
        """kill -9 of everything in the container but its init, which ends with it: what a crash looks like.

        `docker kill` is a person's wish to Docker, after which no restart policy applies.
        """
        # The shell that kills may be killed with the container.
        subprocess.run(
            ["docker", "exec", self.container(service), "python", "-c", KILL_ALL],
            capture_output=True,
            check=False,
        )

    @contextmanager
    def foreground(self, timeout_s: float = 120.0) -> Iterator[subprocess.Popen[str]]:
        """`compose up` as a person starts it; at the end of the block Ctrl-C, and the wait for its end."""
        up = subprocess.Popen(
            [*self._command, "up", "--no-build"],
            cwd=ROOT,
            env=self._environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            yield up
            up.send_signal(signal.SIGINT)
            up.wait(timeout_s)
        finally:
            if up.poll() is None:
                up.kill()
                up.wait()

    def last_words(self, lines: int = 15) -> str:
        """How the containers are and what each said last: for the report of a failure."""
        parts = [
            subprocess.run(
                [*self._command, *command],
                cwd=ROOT,
                env=self._environment,
                capture_output=True,
                text=True,
                check=False,
            ).stdout
            for command in (("ps", "-a"), ("logs", "--no-color", f"--tail={lines}"))
        ]
        return "\n".join(parts)

    def recorder(self, *arguments: str, entrypoint: str = "tandem") -> str:
        """Run a command in the recorder's image, with the volume of the logs."""
        return self.compose(
            "run", "--rm", "--no-deps", "-T", "--entrypoint", entrypoint, "recorder", *arguments
        )

    def logs(self) -> list[str]:
        """The logs in the volume, oldest first."""
        return sorted(self.recorder("-c", "ls /logs/*.mcap", entrypoint="sh").split())


def docker(*arguments: str) -> str:
    """Run a docker command; its standard output."""
    return subprocess.run(["docker", *arguments], capture_output=True, text=True, check=True).stdout


def bridge_address(addresses: str) -> str:
    """The IPv4 address of a bridge on this machine, out of `ip -json addr show dev BRIDGE`.

    Not every engine's `docker network inspect bridge` names a gateway.
    """
    found = [
        address["local"]
        for device in json.loads(addresses)
        for address in device.get("addr_info", [])
        if address.get("family") == "inet"
    ]
    if not found:
        raise AssertionError(f"the engine's bridge has no IPv4 address on this machine: {addresses.strip()}")
    return str(found[0])


@functools.cache
def limits() -> dict[str, str]:
    """The environment for an engine that may not raise limits, as in a sandbox; else {}."""
    probe = ["docker", "run", "--rm", "--ulimit", "rtprio=99", "--ulimit", "memlock=-1", BASE, "true"]
    if subprocess.run(probe, capture_output=True, check=False).returncode == 0:
        return {}
    return {"TANDEM_RTPRIO": "0", "TANDEM_MEMLOCK": "65536"}
