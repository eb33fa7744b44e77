"""What a person reads (rich) and what a program reads (one JSON object on standard output).

What it needs is imported when something is shown: every process comes by here, and most show nothing.
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
    """What was asked cannot be done; the text says why and what to do, and is all that is shown."""


def console(as_json: bool) -> Console:
    """Where to write for a person: standard output, or standard error when a program reads the former."""
    from tandem.console import PlainConsole

    return PlainConsole(stderr=as_json)


def say(console: Console, *lines: str, style: str | None = None) -> None:
    """Lines for a person as they are: none is broken."""
    for text in lines:
        console.print(text, style=style, soft_wrap=True)


def write(text: str) -> None:
    """Text on standard output for a person or a program, without a console's widths and styles."""
    sys.stdout.write(printable(text))
    sys.stdout.flush()


def emit(result: Mapping[str, Any]) -> None:
    """One JSON object on standard output, in ASCII; NaN becomes null, which JSON has."""
    import msgspec

    # msgspec's own encoder refuses the name of a file that is not UTF-8.
    tree = _finite(msgspec.to_builtins(result, enc_hook=_plain))
    write(json.dumps(tree, separators=(",", ":")) + "\n")


def complain(text: str, as_json: bool) -> None:
    """A message for a person on standard error; for a program too, `{"error": ...}` on standard output."""
    say(console(as_json=True), f"tandem: {text}", style="red")
    if as_json:
        emit({"error": text})


def progress_bar(console: Console) -> Progress:
    """A bar of things done, on a terminal."""
    from rich.progress import MofNCompleteColumn, TimeRemainingColumn

    return _bar(console, MofNCompleteColumn(), TimeRemainingColumn())


def share_bar(console: Console) -> Progress:
    """A bar of shares of a whole, on a terminal."""
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
    """Raises `Refused` for an option's value that is not from `low` to `high`; NaN is not."""
    if value < low:
        raise Refused(f"{option} {value:g}: at least {low:g}")
    if not value <= high:
        raise Refused(f"{option} {value:g}: at most {high:g}")


def _finite(value: Any) -> Any:
    """A plain tree with null for every number that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(below) for key, below in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(below) for below in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plain(value: object) -> Any:
    """numpy scalars and arrays, paths, anything with a plain form."""
    for method in ("tolist", "item"):
        convert = getattr(value, method, None)
        if convert is not None:
            return convert()
    return str(value)
