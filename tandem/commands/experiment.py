"""`tandem experiment`: list experiments and run one."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Command
from tandem.terminal import Refused

if TYPE_CHECKING:
    from node_runtime.config.sections import Config
    from tandem.experiments.study.results import FailedRun
    from tandem.experiments.study.runner import Workplace

MOST_TOLD = 10
"""Failed runs on the terminal."""


@dataclass(frozen=True, kw_only=True)
class Experiment(Command):
    """Run an experiment, `paper` or a file of your own, and report it on one page; `list` names the shipped ones."""

    EXTRAS = "experiment"

    what: Annotated[Positional[str], arg(metavar="NAME|FILE.toml|list")]
    """A shipped experiment, your own file ("Experiments" in the documentation), or `list`."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(needed, except for list)")] = None
    """Folder of the report. An interrupted experiment continues from the files there."""
    quick: bool = False
    """Only a few seeds, states and values: a check that everything works, in minutes."""
    jobs: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one a core)")] = None
    """Number of simultaneous runs; the figures do not depend on it."""
    cluster: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")] = (
        None
    )
    """Make the runs on the workers of a Dask scheduler, tcp://127.0.0.1:8786 or tls://HOST:8786."""
    only: Annotated[str | None, arg(metavar="GROUP", help_behavior_hint="(default: all)")] = None
    """Only one group of the experiment."""

    def run(self) -> int:
        if self.what == "list":
            return self._list()
        if self.out is None:
            raise Refused("--out DIR is missing: name the folder for the report")
        return self._run(self.out)

    def _list(self) -> int:
        from run_log.reporting.canvas import load_matplotlib

        load_matplotlib()
        from tandem.experiments.experiment import overview
        from tandem.experiments.study.declaration import load

        told = []
        for name, path in _shipped_files().items():
            about = overview(load(path))
            told.append(about)
            self.say(f"{name}: {about['title']}")
            self.say(f"  groups: {', '.join(about['groups'])}", style="dim")
        if not told:
            raise Refused("no experiment is shipped with this installation; name a file of your own")
        self.emit({"experiments": told})
        return 0

    def _run(self, out: Path) -> int:
        """Run it, and leave report.html, summary.json and logs in `out`."""
        import msgspec

        from controller_node.build import build_plant
        from run_log.reporting.canvas import load_matplotlib

        load_matplotlib()
        from tandem.experiments import experiment
        from tandem.experiments.study.declaration import load
        from tandem.experiments.study.runner import RunnerError

        open_workplace = self._workplace()
        path = _find(self.what)
        declared = load(path)
        plant = build_plant(experiment.settings(declared, str(path)))
        name = self.what if self.what in _shipped_files() else path.name
        command = f"tandem experiment {name} --out DIR" + (" --quick" if self.quick else "")
        began = time.monotonic()
        with terminal.progress_bar(self.console) as bar:
            tasks = {}

            def progress(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = bar.add_task(stage, total=total)
                bar.update(tasks[stage], completed=done, total=total)

            try:
                made = experiment.run(
                    *(declared, str(path), plant, out, open_workplace, command),
                    quick=self.quick,
                    only=self.only,
                    progress=progress,
                )
            except RunnerError as error:
                raise Refused(str(error)) from error
            except OSError as error:
                raise Refused(f"{error.filename or out}: cannot be written: {error.strerror}") from error
            except KeyboardInterrupt:
                text = f"interrupted; finished runs are kept in {out}; the same command continues from there"
                self.say(text)
                raise
        seconds = time.monotonic() - began
        self.say(f"{len(made.rows)} runs in {seconds:.0f} s")
        self._tell(made.failed)
        self.say(*(f"wrote {file}" for file in (made.report, made.summary)))
        self.emit(
            {
                "report": str(made.report),
                "summary": str(made.summary),
                "logs": made.logs,
                "seconds": seconds,
                "rows": msgspec.to_builtins(made.rows),
                "failed": msgspec.to_builtins(made.failed),
            }
        )
        return 1 if made.failed else 0

    def _workplace(self) -> Callable[[Iterable[Config]], Workplace]:
        """Return the function that opens the workplace of the runs."""
        from tandem.experiments.study.runner import Processes

        if self.cluster is None:
            if self.jobs is not None:
                terminal.limited("--jobs", self.jobs, 1, 1024)
            count = self.jobs or len(os.sched_getaffinity(0))
            return lambda configs: Processes(count)
        if self.jobs is not None:
            raise Refused(
                "--jobs is about this machine; of a cluster each worker says how many threads it has"
            )
        try:
            from tandem.experiments.cluster.workplace import Cluster
        except ModuleNotFoundError as error:
            how = "pip install 'tandem-control[experiment,cluster]'"
            raise Refused(f"--cluster needs {error.name}: {how}") from error
        from tandem.experiments.cluster.address import checked
        from tandem.experiments.cluster.bundle import gather

        address = checked(self.cluster)
        return lambda configs: Cluster(address, gather(configs), lambda text: self.say(text, style="dim"))

    def _tell(self, failed: list[FailedRun]) -> None:
        """Print the error of each of the first failed runs."""
        for run in failed[:MOST_TOLD]:
            what = f"case {run.case!r}{' (with the true h)' if run.floor else ''}, seed {run.seed}"
            where = f" on worker {run.failure.where}" if run.failure.where else ""
            self.say(f"failed: {what}{where}: {run.failure.text}", style="red")
        if failed:
            self.say(
                f"{len(failed)} runs failed; summary.json has the reason of each, with its traceback. The same command "
                "makes them again",
                style="red",
            )


def _shipped_files() -> dict[str, Path]:
    """Return the shipped experiments, by name."""
    from node_runtime.config.shipped import shipped

    return {path.stem: path for path in sorted(shipped("experiments").glob("*.toml"))}


def _find(what: str) -> Path:
    """Return a shipped experiment by name, or a file. Raises `Refused`."""
    from node_runtime.config.strict import did_you_mean

    files = _shipped_files()
    if what in files:
        return files[what]
    path = Path(what)
    if path.suffix == ".toml" or path.exists():
        return path
    hint = did_you_mean(what, files, f"there are {', '.join(files) or 'none'}")
    raise Refused(f"no shipped experiment has the name {what!r}; {hint} You can also name a file, FILE.toml")
