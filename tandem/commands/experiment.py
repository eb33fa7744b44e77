"""`tandem experiment`: list experiments and run one."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from tandem import terminal
from tandem.commands.base import Command
from tandem.terminal import Refused


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

        if self.jobs is not None:
            terminal.limited("--jobs", self.jobs, 1, 1024)
        path = _find(self.what)
        declared = load(path)
        plant = build_plant(experiment.settings(declared, str(path)))
        name = self.what if self.what in _shipped_files() else path.name
        command = f"tandem experiment {name} --out DIR" + (" --quick" if self.quick else "")
        processes = self.jobs or len(os.sched_getaffinity(0))
        began = time.monotonic()
        with terminal.progress_bar(self.console) as bar:
            tasks = {}

            def progress(stage: str, done: int, total: int) -> None:
                if stage not in tasks:
                    tasks[stage] = bar.add_task(stage, total=total)
                bar.update(tasks[stage], completed=done, total=total)

            try:
                made = experiment.run(
                    *(declared, str(path), plant, out, processes, command),
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
        self.say(*(f"wrote {file}" for file in (made.report, made.summary)))
        self.emit(
            {
                "report": str(made.report),
                "summary": str(made.summary),
                "logs": made.logs,
                "seconds": seconds,
                "rows": msgspec.to_builtins(made.rows),
            }
        )
        return 0


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
