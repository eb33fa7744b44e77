"""Drawing with Matplotlib's own defaults, independent of the settings of person and machine.

Nothing here imports Matplotlib before something is drawn: its import alone fails for some settings.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from node_runtime.printable import printable
from node_runtime.whole_file import write_whole
from run_log.errors import LogError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 200
"""Largest length of a reason in characters: LaTeX returns its whole log."""


def words(text: str) -> str:
    """Escape a name or unit: Matplotlib would read text between two `$` as a formula."""
    return printable(text).replace("$", r"\$")


class PictureError(LogError):
    """A picture cannot be drawn or written; the text says which and why. No other result depends on it."""


@contextmanager
def drawing(what: str | Path) -> Iterator[None]:
    """Draw independently of local settings. Raises `PictureError` for every failure.

    what: the picture's name or file, for the message.
    """
    try:
        load_matplotlib()
        from matplotlib import rc_context, rcParamsDefault

        # A `Figure` without pyplot needs no backend, and setting one would import it.
        with rc_context({key: rcParamsDefault[key] for key in rcParamsDefault if key != "backend"}):
            yield
    except (
        ModuleNotFoundError,
        PictureError,
    ):  # drawing is not possible here; the caller says what to install
        raise
    except OSError as error:
        raise PictureError(f"{what}: cannot be written: {error.strerror}") from error
    except Exception as error:
        lines = str(error).splitlines() or [""]
        raise PictureError(
            f"{what}: cannot be drawn: {lines[0][:LONGEST]} ({type(error).__name__})"
        ) from error


def load_matplotlib() -> None:
    """Import Matplotlib with its own defaults: a person's backend or settings file may be invalid.

    Its import reads the first `matplotlibrc` of the current folder, `MATPLOTLIBRC`, and the person's configuration; one
    that is no text ends it.
    """
    found = find_spec("matplotlib")
    if "matplotlib" in sys.modules or found is None or found.origin is None:
        import matplotlib

        return
    own = Path(found.origin).parent / "mpl-data"
    kept = {name: os.environ.pop(name) for name in ("MPLBACKEND", "MATPLOTLIBRC") if name in os.environ}
    os.environ["MATPLOTLIBRC"] = str(own / "matplotlibrc")
    try:
        with _elsewhere(own) if os.path.lexists("matplotlibrc") else nullcontext():
            import matplotlib  # noqa: F401
    finally:
        del os.environ["MATPLOTLIBRC"]
        os.environ.update(kept)


@contextmanager
def _elsewhere(folder: Path) -> Iterator[None]:
    """Run with `folder` as the current one."""
    here = os.open(".", os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.chdir(folder)
        yield
    finally:
        os.fchdir(here)
        os.close(here)


def save(make: Callable[[], Figure], path: Path, dpi: int | None = None) -> Path:
    """Draw a figure and write it to `path`, in the format of the name's ending; completely or not at all.

    dpi: dots per inch; None: the figure's own.

    Raises:
        PictureError: it cannot be drawn or written, no picture has that ending, or a link, a device or a pipe has
            that name.
    """
    with drawing(path):
        figure, ending = make(), path.suffix.lstrip(".").lower()
        known = figure.canvas.get_supported_filetypes()
        if ending not in known:
            raise PictureError(
                f"{path}: not a picture format; use .png, or one of {', '.join(sorted(known))}"
            )
        buffer = io.BytesIO()
        figure.savefig(buffer, format=ending, dpi=dpi or "figure")
        write_whole(path, buffer.getvalue())
    return path
