"""The four commands of docs/tutorials/remote.md, run in two network namespaces.

`make remote-test`; needs root.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from run_log.reading.reader import read_run
from run_log.reporting.summary import summarise
from tests.helpers.paths import DOCS

PAGE = DOCS / "tutorials/remote.md"
PLANT, TRAINER = "10.0.0.5", "10.0.0.6"
SCP = f"""#!/bin/sh
# In place of scp, for there is one file system: `scp -rp FOLDER {TRAINER}:NAME` is a copy into the trainer's home.
exec cp -rp "$2" "$TRAINER_HOME/${{3#{TRAINER}:}}"
"""

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or shutil.which("ip") is None, reason="network namespaces need root and iproute2"
)


def commands() -> list[str]:
    """The commands of the page's steps, without what they print."""
    steps = PAGE.read_text(encoding="utf-8").split("\n## Steps\n", 1)[1].split("\n## ", 1)[0]
    found = re.findall(r"^ *((?:tandem|scp) .*)$", steps, re.MULTILINE)
    assert len(found) == 4, f"the steps of {PAGE} are four commands"
    return found


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@contextmanager
def two_machines() -> Iterator[tuple[str, str]]:
    """Two network namespaces, joined by one cable, with the page's addresses."""
    names = f"plant{os.getpid()}", f"train{os.getpid()}"
    with ExitStack() as stack:
        for name in names:
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name)
            ip("-n", name, "link", "set", "lo", "up")
        ip(
            "link",
            "add",
            "eth0",
            "netns",
            names[0],
            "type",
            "veth",
            "peer",
            "name",
            "eth0",
            "netns",
            names[1],
        )
        for name, address in zip(names, (PLANT, TRAINER), strict=True):
            ip("-n", name, "address", "add", f"{address}/24", "dev", "eth0")
            ip("-n", name, "link", "set", "eth0", "up")
        yield names


class Machine:
    """A namespace, a home and the environment's commands."""

    def __init__(self, name: str, home: Path, tools: Path, trainer_home: Path):
        self._name, self.home = name, home
        path = os.pathsep.join((str(tools), str(Path(sys.executable).parent), os.environ["PATH"]))
        self._environment = {**os.environ, "PATH": path, "TRAINER_HOME": str(trainer_home)}

    @contextmanager
    def start(self, command: str) -> Iterator[subprocess.Popen[str]]:
        """A command of the page, ended at the end of the block."""
        with (self.home / "said.txt").open("a") as said:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self._name, *shlex.split(command)],
                cwd=self.home,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                text=True,
            )
            try:
                yield process
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()

    def run(self, command: str, timeout_s: float) -> None:
        with self.start(command) as process:
            code = process.wait(timeout_s)
            assert code == 0, f"{command}: exit code {code}\n{self.said()}"

    def said(self) -> str:
        return (self.home / "said.txt").read_text()


def test_four_commands_move_the_trainer_to_another_machine(tmp_path: Path):
    create, copy, run, train = commands()
    tools, here, there = (tmp_path / name for name in ("tools", "plant", "trainer"))
    for folder in (tools, here, there):
        folder.mkdir()
    (tools / "scp").write_text(SCP)
    (tools / "scp").chmod(0o755)
    with two_machines() as (plant_net, trainer_net):
        plant, trainer = Machine(plant_net, here, tools, there), Machine(trainer_net, there, tools, there)
        plant.run(create, 30.0)
        plant.run(copy, 30.0)
        assert [path.name for path in there.iterdir() if path.is_dir()] == ["trainer-keys"]
        with trainer.start(train) as training:
            plant.run(run, 300.0)
            assert training.poll() is None, trainer.said()
            training.send_signal(signal.SIGTERM)
            assert training.wait(20.0) == 0, trainer.said()
    summary = summarise(read_run(here / "run.mcap"))
    sys.stdout.write(f"\n{summary.ticks} ticks, {summary.weights_adopted} sets of weights adopted\n")
    assert summary.weights_adopted >= 5, trainer.said()
    assert "following" in trainer.said()
    # The rights suffice for all that it does.
    router = (here / "run.processes" / "router.txt").read_text()
    assert "certificates, on tls/0.0.0.0:7448" in router
    assert "bad " not in router, router
