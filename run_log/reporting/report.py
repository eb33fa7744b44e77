"""`tandem report`: pictures of a run, from its log alone."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from run_log.reporting.canvas import PictureError, drawing, save
from run_log.reporting.traces import traces
from run_log.run import Run, plant_of


class Report(NamedTuple):
    """The pictures that were drawn, and the reasons why others were not."""

    pictures: list[Path]
    failed: list[PictureError]


def report(run: Run, out_dir: str | Path) -> Report:
    """Draw the log NAME.mcap into `out_dir`: NAME.png is the whole run, NAME-states.png etc. its parts.

    Raises:
        LogError: the log contains nothing to draw.
    """
    path, out_dir = run.path, Path(out_dir)
    data = traces(run)
    made = Report([], [])
    try:
        with drawing(path):
            from run_log.reporting import plots

            makes = {"": lambda: plots.overview(data, title(run))}
            makes |= {f"-{name}": make for name, make in plots.pictures(data).items()}
    except PictureError as error:
        made.failed.append(error)
        return made
    for name, make in makes.items():
        try:
            made.pictures.append(save(make, out_dir / f"{path.stem}{name}.png"))
        except PictureError as error:
            made.failed.append(error)
    return made


def picture(run: Run, path: str | Path) -> Path:
    """Draw the whole run on one page.

    Raises:
        LogError: the run contains nothing to draw.
        PictureError: it cannot be drawn or written.
    """
    data = traces(run)
    with drawing(path):
        from run_log.reporting import plots
    return save(lambda: plots.overview(data, title(run)), Path(path))


def title(run: Run) -> str:
    """Return plant, oracle, rate and seed."""
    config = run.config
    cut = ", log cut short" if run.truncated or run.recovered else ""
    return (
        f"{config.name}: {plant_of(run).name}, oracle {config.controller.oracle}, "
        f"{config.rate:g} Hz, seed {config.seed}{cut}"
    )
