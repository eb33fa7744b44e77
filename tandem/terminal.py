"""What a person reads (rich) and what a program reads (one JSON object on standard output).

rich is imported when something is shown: every process comes by here, and most show nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from rich.console import Console


class Refused(Exception):
    """What was asked cannot be done; the text says why and what to do, and is all that is shown."""


def console(as_json: bool) -> Console:
    """Where to write for a person: standard output, or standard error when a program reads the former."""
    from rich.console import Console

    return Console(stderr=as_json, highlight=False, soft_wrap=False)


def emit(result: Mapping[str, Any]) -> None:
    """One JSON object on standard output; NaN becomes null, which JSON has."""
    sys.stdout.write(msgspec.json.encode(result, enc_hook=_plain).decode() + "\n")
    sys.stdout.flush()


def complain(text: str, as_json: bool) -> None:
    """A message for a person on standard error; for a program too, `{"error": ...}` on standard output."""
    from rich.console import Console

    Console(stderr=True, highlight=False).print(f"tandem: {text}", style="red", markup=False, soft_wrap=True)
    if as_json:
        emit({"error": text})


def _plain(value: object) -> Any:
    """numpy scalars and arrays, paths, anything with a plain form."""
    for method in ("tolist", "item"):
        convert = getattr(value, method, None)
        if convert is not None:
            return convert()
    return str(value)
