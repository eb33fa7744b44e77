"""`tandem experiment`: which there are, and running one."""

from __future__ import annotations

import difflib
import os
import time
from pathlib import Path

import msgspec

from tandem import terminal
from tandem.commands.various import log_packages, progress_bar
from tandem.terminal import Refused

SHIPPED = Path(__file__).resolve().parents[2] / "configs" / "experiments"


def files() -> dict[str, Path]:
    """The shipped experiments, by name."""
    return {path.stem: path for path in sorted(SHIPPED.glob("*.toml"))}


def show_list(as_json: bool) -> int:
    from tandem.experiments.experiment import overview
    from tandem.experiments.study.declaration import load

    console = terminal.console(as_json)
    told = []
    for name, path in files().items():
        about = overview(load(path))
        told.append(about)
        console.print(f"{name}: {about['title']}", markup=False, soft_wrap=True)
        console.print(f"  groups: {', '.join(about['groups'])}", style="dim", markup=False, soft_wrap=True)
    if not told:
        raise Refused(
            f"no experiment is shipped with this installation; name a file of your own ({SHIPPED} is empty)"
        )
    if as_json:
        terminal.emit({"experiments": told})
    return 0


def find(what: str) -> Path:
    """A shipped name, or a file. Raises `Refused`."""
    shipped = files()
    if what in shipped:
        return shipped[what]
    path = Path(what)
    if path.suffix == ".toml" or path.exists():
        return path
    near = difflib.get_close_matches(what, shipped, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(shipped) or 'none'}"
    raise Refused(f"no experiment is called {what!r}; {hint} Or name a file, FILE.toml")


def run(what: str, out: Path, quick: bool, jobs: int | None, only: str | None, as_json: bool) -> int:
    """Run it, and leave report.html, summary.json and logs in `out`."""
    with log_packages():
        from tandem.experiments import experiment
        from tandem.experiments.study.declaration import load
        from tandem.experiments.study.runner import RunnerError
    from run_log.errors import LogError
    from tandem.checks import plant_of

    if jobs is not None and jobs < 1:
        raise Refused(f"--jobs {jobs}: at least 1")
    path = find(what)
    declared = load(path)
    plant = plant_of(experiment.settings(declared, str(path)))
    name = what if what in files() else path.name
    command = f"tandem experiment {name} --out DIR" + (" --quick" if quick else "")
    processes = jobs or len(os.sched_getaffinity(0))
    console, began = terminal.console(as_json), time.monotonic()
    with progress_bar(console) as bar:
        tasks = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        try:
            made = experiment.run(
                declared, str(path), plant, out, processes, command, quick, only, progress=progress
            )
        except (RunnerError, LogError) as error:
            raise Refused(str(error)) from error
        except OSError as error:
            raise Refused(f"{error.filename or out}: cannot be written: {error.strerror}") from error
        except KeyboardInterrupt:
            console.print(
                f"interrupted; finished runs are kept in {out}: the same command goes on from there",
                markup=False,
                soft_wrap=True,
            )
            raise
    seconds = time.monotonic() - began
    console.print(f"{len(made.rows)} runs in {seconds:.0f} s", markup=False)
    for file in (made.report, made.summary):
        console.print(f"wrote {file}", markup=False, soft_wrap=True)
    if as_json:
        terminal.emit(
            {
                "report": str(made.report),
                "summary": str(made.summary),
                "logs": made.logs,
                "seconds": seconds,
                "rows": msgspec.to_builtins(made.rows),
            }
        )
    return 0
