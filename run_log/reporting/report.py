"""`tandem report`: pictures of a run, from its log alone."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from node_runtime.whole_file import write_whole
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reporting import plots
from run_log.reporting.traces import traces
from run_log.run import Run


def report(path: str | Path, out_dir: str | Path) -> list[Path]:
    """Draw the log at `path` into `out_dir`: NAME.png is the whole run, NAME-states.png etc. its parts.

    Raises:
        LogError: the log cannot be read or holds nothing to draw; a picture cannot be written.
    """
    path, out_dir = Path(path), Path(out_dir)
    run = read_run(path)
    data = traces(run)
    figures = {f"{path.stem}.png": plots.overview(data, title(run))}
    figures |= {f"{path.stem}-{name}.png": figure for name, figure in plots.pictures(data).items()}
    return [save_picture(figure, out_dir / name) for name, figure in figures.items()]


def picture(run: Run, path: str | Path) -> Path:
    """The whole run on one page. Raises `LogError` as `report` does."""
    return save_picture(plots.overview(traces(run), title(run)), Path(path))


def title(run: Run) -> str:
    """Plant, oracle, rate and seed."""
    config = run.config
    cut = ", log cut short" if run.truncated or run.recovered else ""
    return (
        f"{config.name}: {config.plant.model}, oracle {config.controller.oracle}, "
        f"{config.rate:g} Hz, seed {config.seed}{cut}"
    )


def save_picture(figure: plots.Figure, path: Path, dpi: float | None = None) -> Path:
    """Write a figure whole, in the format that the name's ending says; returns the path.

    Raises:
        LogError: no picture has that ending, the file cannot be written, or it is a link, a device or a pipe.
    """
    ending, known = path.suffix.lstrip(".").lower(), figure.canvas.get_supported_filetypes()
    if ending not in known:
        raise LogError(
            f"{path}: no picture has that ending; name it .png, or one of {', '.join(sorted(known))}"
        )
    content = BytesIO()
    figure.savefig(content, format=ending, dpi=figure.dpi if dpi is None else dpi)
    try:
        write_whole(path, content.getvalue())
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror}") from error
    return path
