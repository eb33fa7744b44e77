"""Sweeps on a real scheduler under faults, and their cost.

`make cluster-test` takes about 20 minutes, and needs root for the full disk. Environment: `GROUP` is a group of the
paper's experiment, `TRIVIAL` the number of trivial runs over which the client's memory is measured.
"""

from __future__ import annotations

import json
import os
import signal
import statistics
import subprocess
import sys
import time
import venv
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from threading import Thread

import pytest

from lbmpc.plants import get_plant
from tandem.experiments.cluster.bundle import gather
from tandem.experiments.cluster.workplace import Cluster
from tandem.experiments.study.declaration import load, resolve
from tandem.experiments.study.plan import rows
from tandem.experiments.study.runner import Processes, Want, Workplace, run_all, wanted
from tests.helpers.dask_cluster import DaskCluster, dask_cluster, free_port

GROUP = os.environ.get("GROUP", "survival-cheap")
TRIVIAL = int(os.environ.get("TRIVIAL", "10000"))
HOURS = 4 * 3600.0
SLEEPS = 1.0
"""Seconds that each run of the measurement of the overhead sleeps."""
SMALL = """
name = "small"
title = "Small"
steps = 2
[limits]
seconds = 1000.0
[set]
controller = { horizon = 2, oracle = "linear", solver = { compile = "never" } }
"""
FINE = """
[[group]]
name = "fine"
title = "Fine"
seeds = 8
[[case]]
name = "noisy"
group = "fine"
set.plant.sensors.noise = 0.001
"""
ENDLESS = """
[[group]]
name = "endless"
title = "Endless"
[[case]]
name = "never ends"
group = "endless"
set.plant.truth = "slow.py:ENDLESS"
"""
SLOW = """
import time

class Sleeps:
    def __init__(self, seconds):
        self.seconds, self.due = seconds, True
    def step(self, x, u, dt):
        if self.due:
            self.due = False
            time.sleep(self.seconds)
        return x

ENDLESS = Sleeps(1e6)
"""


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[DaskCluster]:
    with dask_cluster(tmp_path / "cluster", "first", "second") as cluster:
        yield cluster


class Command:
    """One `tandem experiment` in a separate process."""

    def __init__(self, *arguments: str | Path, cwd: Path | None = None):
        self.popen = subprocess.Popen(
            [sys.executable, "-P", "-m", "tandem", "experiment", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=cwd,
            # A background shell has SIGINT ignored, and children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def end(self) -> tuple[int, str]:
        said, _ = self.popen.communicate(timeout=HOURS)
        assert "Traceback" not in said, said
        return self.popen.returncode, said

    def until(self, holds: Callable[[], bool]) -> None:
        while not holds():
            assert self.popen.poll() is None, self.popen.communicate()
            time.sleep(0.1)


def runs(out: Path) -> int:
    return len(list(out.glob("runs/*.json")))


def figures(out: Path) -> list[dict[str, object]]:
    """Return the rows of a summary, without the solve times."""
    found = json.loads((out / "summary.json").read_text())
    assert found["failed"] == []
    return [{key: value for key, value in row.items() if key != "solve_ms"} for row in found["rows"]]


def test_rows_survive_dead_late_and_new_workers_and_a_new_scheduler(
    cluster: DaskCluster, tmp_path: Path
) -> None:
    there, here = tmp_path / "there", tmp_path / "here"
    began = time.monotonic()
    command = Command("paper", "--only", GROUP, "--out", there, "--cluster", cluster.address)
    command.until(lambda: runs(there) >= 10)
    cluster.kill("first")
    say(f"killed a worker after {runs(there)} runs")
    command.until(lambda: runs(there) >= 20)
    cluster.start_worker("late")
    say(f"started a worker after {runs(there)} runs")
    command.until(lambda: runs(there) >= 40)
    cluster.kill("scheduler")
    say(f"killed the scheduler after {runs(there)} runs")
    for name in ("second", "late"):
        cluster.processes.pop(name).wait(60.0)  # they end with their scheduler
    cluster.start_scheduler()
    for name in ("second again", "late again"):
        cluster.start_worker(name)
    code, said = command.end()
    say(said)
    assert code == 0
    say(f"{runs(there)} runs on the cluster: {time.monotonic() - began:.0f} s")
    code, said = Command("paper", "--only", GROUP, "--out", here, "--jobs", "1").end()
    assert code == 0, said
    assert figures(there) == figures(here)
    assert len(figures(here)) > 50 or "GROUP" in os.environ
    for path in (here / "runs").iterdir():
        assert path.read_bytes() == (there / "runs" / path.name).read_bytes()
    say(f"{len(figures(here))} rows are equal")


def test_the_overhead_is_below_5_percent(cluster: DaskCluster, tmp_path: Path) -> None:
    """Measure the overhead with sleeping runs, which other load affects little: alternating, with the median ratio."""
    (tmp_path / "slow.py").write_text(SLOW + f"S = [Sleeps({SLEEPS} + i * 1e-9) for i in range(1000)]\n")
    names = "".join(f"S{i} = S[{i}]\n" for i in range(120))
    with open(tmp_path / "slow.py", "a") as file:
        file.write(names)
    path = tmp_path / "sleeps.toml"
    truths = ", ".join(f'"slow.py:S{i}"' for i in range(120))
    path.write_text(
        SMALL
        + '[[group]]\nname = "g"\ntitle = "G"\n[[case]]\nname = "c"\ngroup = "g"\n'
        + f'vary."plant.truth" = [{truths}]\n'
    )
    wants = list(_wants(path, tmp_path).items())[
        ::2
    ]  # without the floors, which do not exist for such a truth
    bundle = gather(want.job.config for _key, want in wants)
    ratios = []
    for number in range(3):
        part = dict(wants[40 * number : 40 * number + 40])
        seconds = []
        for name, workplace in (
            ("here", Processes(2)),
            ("there", Cluster(cluster.address, bundle)),
        ):
            seconds.append(_seconds(workplace, part, tmp_path / f"{name}-{number}"))
        ratios.append(seconds[1] / seconds[0])
        say(
            f"40 runs of {SLEEPS:g} s, two at a time: here {seconds[0]:.2f} s, on the cluster {seconds[1]:.2f} s"
        )
    say(f"ratios: {', '.join(f'{ratio:.3f}' for ratio in ratios)}")
    assert statistics.median(ratios) < 1.05


def _wants(path: Path, folder: Path) -> dict[str, Want]:
    cases = resolve(load(path), get_plant("moore_greitzer"), str(path))
    return wanted(list(rows(cases)), set(), folder / "logs")


def _seconds(workplace: Workplace, wants: dict[str, Want], out: Path) -> float:
    """Return the duration from the first to the last result, which excludes the start of the processes."""
    times: list[float] = []
    with closing(workplace):
        made = run_all(wants, out, workplace, lambda done, total: times.append(time.monotonic()))
    assert not made.failures
    return times[-1] - times[2]  # the first call is at the start; two run at a time


def test_the_clients_memory_does_not_grow_with_the_runs(cluster: DaskCluster, tmp_path: Path) -> None:
    path = tmp_path / "small.toml"
    path.write_text(SMALL + FINE.replace("seeds = 8", f"seeds = {TRIVIAL // 2}"))
    wants = _wants(path, tmp_path)
    seen: list[tuple[int, float]] = []

    def look(done: int, total: int) -> None:
        if done % max(1, total // 20) == 0:
            seen.append((done, _memory_mb()))

    cases = Cluster(cluster.address, gather(want.job.config for want in wants.values()))
    with closing(cases):
        run_all(wants, tmp_path / "runs", cases, look)
    say(", ".join(f"{done}: {mb:.0f} MB" for done, mb in seen))
    half = len(seen) // 2
    assert seen[-1][1] - seen[half][1] < 20.0


def _memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


# -- messages ------------------------------------------------------------------------------------------------


def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(cluster: DaskCluster, tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL.replace("steps = 2", "steps = 200") + FINE)
    arguments = ("small.toml", "--out", "out", "--cluster", cluster.address)
    command = Command(*arguments, cwd=tmp_path)
    command.until(lambda: runs(tmp_path / "out") >= 2)
    command.popen.send_signal(signal.SIGINT)
    code, said = command.end()
    assert code == 130
    assert "the same command continues from there" in said
    kept = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "runs").iterdir()}
    assert 2 <= len(kept) < 16
    code, said = Command(*arguments, cwd=tmp_path).end()
    assert code == 0, said
    assert all(path.stat().st_mtime_ns == when for path, when in kept.items())


def test_a_run_that_never_ends_is_stopped_and_the_others_are_made(
    cluster: DaskCluster, tmp_path: Path
) -> None:
    (tmp_path / "slow.py").write_text(SLOW)
    (tmp_path / "small.toml").write_text(SMALL.replace("1000.0", "30.0") + FINE + ENDLESS)
    arguments = ("small.toml", "--out", "out", "--cluster", cluster.address)
    code, said = Command(*arguments, cwd=tmp_path).end()
    say(said)
    assert code == 1
    assert "case 'never ends'" in said
    assert "it did not end within 30 s" in said
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert len(told["rows"]) == 8
    assert told["failed"][0]["failure"]["kind"] == "time"
    assert "runs failed and are in no table" in (tmp_path / "out" / "report.html").read_text()


def test_nothing_answers_at_a_wrong_address(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL + FINE)
    address = f"tcp://127.0.0.1:{free_port()}"
    code, said = Command("small.toml", "--out", "out", "--cluster", address, cwd=tmp_path).end()
    assert code == 2
    assert f"no Dask scheduler answers at {address}" in said.replace("\n", " ")


def test_a_worker_without_torch_is_refused_by_name(cluster: DaskCluster, tmp_path: Path) -> None:
    cluster.start_worker("bare", python=str(_environment_without("torch", tmp_path / "env")))
    (tmp_path / "small.toml").write_text(SMALL + FINE.replace("seeds = 8", "seeds = 200"))
    command = Command("small.toml", "--out", "out", "--cluster", cluster.address, cwd=tmp_path)
    code, said = command.end()
    say(said)
    assert code == 0
    assert "worker bare (" in said
    assert "is refused: other packages (torch is missing, here 2." in said


def _environment_without(package: str, folder: Path) -> Path:
    """Return the Python of an environment with all packages of this one except one."""
    venv.create(folder, with_pip=False, symlinks=True)
    (theirs,) = folder.glob("lib/python*/site-packages")
    for path in Path(pytest.__file__).parents[1].iterdir():
        if not path.name.startswith(package):
            (theirs / path.name).symlink_to(path)
    return folder / "bin" / "python"


@pytest.mark.skipif(os.geteuid() != 0, reason="mounts a file system")
def test_a_full_disk_ends_the_command_and_the_same_one_goes_on(cluster: DaskCluster, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(out)], check=True)
    try:
        (tmp_path / "small.toml").write_text(SMALL + FINE.replace("seeds = 8", "seeds = 40"))
        arguments = ("small.toml", "--out", "out", "--cluster", cluster.address)
        code, said = Command(*arguments, cwd=tmp_path).end()
        say(said)
        assert code == 2
        assert "cannot be written: No space left on device" in said
        kept = runs(out)
        assert 0 < kept < 80
        subprocess.run(["mount", "-o", "remount,size=64m", str(out)], check=True)
        code, said = Command(*arguments, cwd=tmp_path).end()
        assert code == 0, said
        assert runs(out) == 80
    finally:
        subprocess.run(["umount", "-l", str(out)], check=True)


def test_a_worker_that_is_started_after_the_command_makes_its_runs(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL + FINE)
    with dask_cluster(tmp_path / "cluster") as empty:
        command = Command("small.toml", "--out", "out", "--cluster", empty.address, cwd=tmp_path)
        Thread(target=lambda: (time.sleep(5.0), empty.start_worker("only")), daemon=True).start()
        code, said = command.end()
    assert code == 0, said
    assert "worker only (" in said
