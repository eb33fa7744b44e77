"""Output for a person (rich) and for a program (one JSON object on standard output).

rich is imported on first use: every process imports this module, and most print nothing.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from node_runtime.printable import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, ProgressColumn


class Refused(Exception):
    """The request cannot be done. The message gives the reason and a remedy, and no traceback is shown."""


def console(as_json: bool) -> Console:
    """Where to write for a person: standard output, or standard error if a program reads standard output."""
    from tandem.console import PlainConsole

    return PlainConsole(stderr=as_json)


def say(console: Console, *lines: str, style: str | None = None) -> None:
    """Print lines for a person without breaking any."""
    for text in lines:
        console.print(text, style=style, soft_wrap=True)


def write(text: str) -> None:
    """Print text to standard output for a person or a program, without a console's widths and styles."""
    sys.stdout.write(printable(text))
    sys.stdout.flush()


def emit(result: Mapping[str, Any]) -> None:
    """Print one JSON object to standard output, in ASCII; NaN becomes null, since JSON has no NaN."""
    import msgspec

    # msgspec's own encoder refuses a file name that is not UTF-8.
    tree = _finite(msgspec.to_builtins(result, enc_hook=_plain))
    write(json.dumps(tree, separators=(",", ":")) + "\n")


def complain(text: str, as_json: bool) -> None:
    """Print a message for a person to standard error; for a program also `{"error": ...}` to standard output."""
    say(console(as_json=True), f"tandem: {text}", style="red")
    if as_json:
        emit({"error": text})


def progress_bar(console: Console) -> Progress:
    """A progress bar of counted items, on a terminal."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    return _bar(console, MofNCompleteColumn(), TimeRemainingColumn())


def share_bar(console: Console) -> Progress:
    """A progress bar of shares of a whole, on a terminal."""
    from rich.progress import TaskProgressColumn, TimeElapsedColumn

    return _bar(console, TaskProgressColumn(), TimeElapsedColumn())


def _bar(console: Console, *columns: ProgressColumn) -> Progress:
    from rich.progress import BarColumn, Progress, TextColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        *columns,
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )


def limited(option: str, value: float, low: float, high: float) -> None:
    """Raise `Refused` if an option's value is not from `low` to `high`, or NaN."""
    if value < low:
        raise Refused(f"{option} {value:g}: at least {low:g}")
    if not value <= high:
        raise Refused(f"{option} {value:g}: at most {high:g}")


def _finite(value: Any) -> Any:
    """Return a plain tree with null for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(below) for key, below in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(below) for below in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plain(value: object) -> Any:
    """Convert numpy scalars and arrays, paths, and other objects with a plain form."""
    for method in ("tolist", "item"):
        convert = getattr(value, method, None)
        if convert is not None:
            return convert()
    return str(value)
