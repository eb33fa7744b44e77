"""Where pictures are drawn: Matplotlib as it comes, whatever settings the person or the machine has for it.

Nothing here imports Matplotlib before something is drawn: its import alone fails for some settings.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from run_log.errors import LogError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONGEST = 200
"""Characters of a reason: LaTeX gives its whole log."""


class PictureError(LogError):
    """A picture cannot be drawn or written; the text says which and why. Nothing else depends on it."""


@contextmanager
def drawing(what: str | Path) -> Iterator[None]:
    """What is drawn within depends on nobody's settings. Raises `PictureError`, whatever fails.

    what: the picture's name or file, for the message.
    """
    try:
        load_matplotlib()
        from matplotlib import rc_context, rcParamsDefault

        # A `Figure` without pyplot has no use for a backend, and to set one would import it.
        with rc_context({key: rcParamsDefault[key] for key in rcParamsDefault if key != "backend"}):
            yield
    except ModuleNotFoundError:  # nothing can be drawn here; whoever asked says what to install
        raise
    except OSError as error:
        raise PictureError(f"{what}: cannot be written: {error.strerror}") from error
    except Exception as error:
        lines = str(error).splitlines() or [""]
        raise PictureError(
            f"{what}: cannot be drawn: {lines[0][:LONGEST]} ({type(error).__name__})"
        ) from error


def load_matplotlib() -> None:
    """Import it without the person's choice of a backend and of a settings file, either of which may be a mistake."""
    kept = {name: os.environ.pop(name) for name in ("MPLBACKEND", "MATPLOTLIBRC") if name in os.environ}
    try:
        import matplotlib  # noqa: F401
    finally:
        os.environ.update(kept)


def save(make: Callable[[], Figure], path: Path, dpi: int | None = None) -> Path:
    """Draw a figure and write it to `path`, in the format of that name; whole or not at all. Raises `PictureError`.

    dpi: dots per inch; None: the figure's own.
    """
    with drawing(path):
        buffer = io.BytesIO()
        make().savefig(buffer, format=path.suffix[1:] or "png", dpi=dpi or "figure")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(buffer.getvalue())
    return path
