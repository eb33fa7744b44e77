"""What a person reads (rich) and what a program reads (one JSON object on standard output).

What it needs is imported when something is shown: every process comes by here, and most show nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, ProgressColumn


class Refused(Exception):
    """What was asked cannot be done; the text says why and what to do, and is all that is shown."""


def console(as_json: bool) -> Console:
    """Where to write for a person: standard output, or standard error when a program reads the former."""
    from rich.console import Console

    return Console(stderr=as_json, highlight=False, soft_wrap=False)


def say(console: Console, *lines: str, style: str | None = None) -> None:
    """Lines for a person as they are: nothing in them is markup, and none is broken."""
    for text in lines:
        console.print(text, style=style, markup=False, soft_wrap=True)


def emit(result: Mapping[str, Any]) -> None:
    """One JSON object on standard output; NaN becomes null, which JSON has, and so is what UTF-8 can say."""
    import msgspec

    try:
        text = msgspec.json.encode(result, enc_hook=_plain)
    except UnicodeEncodeError:  # the name of a file that is no text
        text = msgspec.json.encode(_readable(msgspec.to_builtins(result, enc_hook=_plain)))
    sys.stdout.write(text.decode() + "\n")
    sys.stdout.flush()


def complain(text: str, as_json: bool) -> None:
    """A message for a person on standard error; for a program too, `{"error": ...}` on standard output."""
    from rich.console import Console

    Console(stderr=True, highlight=False).print(f"tandem: {text}", style="red", markup=False, soft_wrap=True)
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
        TextColumn("{task.description}"),
        BarColumn(),
        *columns,
        console=console,
        disable=not console.is_terminal,
        transient=True,
    )


def _readable(value: Any) -> Any:
    from node_runtime.config.strict import readable

    if isinstance(value, dict):
        return {key: _readable(below) for key, below in value.items()}
    if isinstance(value, list | tuple):
        return [_readable(below) for below in value]
    return readable(value) if isinstance(value, str) else value


def _plain(value: object) -> Any:
    """numpy scalars and arrays, paths, anything with a plain form."""
    for method in ("tolist", "item"):
        convert = getattr(value, method, None)
        if convert is not None:
            return convert()
    return str(value)
