"""Write a plant of numbers as a Python file that a person can read and change."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lbmpc.plants import Known
from node_runtime.printable import printable
from tandem.terminal import Refused

DIGITS = 12
"""Significant digits of a matrix entry: more than any log determines, and enough for a horizon."""
COMMENTS = {
    "A": "x+ = A x + B u in deviations from (x_e, u_e)",
    "offset": "x+ - x at (x_e, u_e): Tandem takes the nearest point of rest for (x_e, u_e)",
    "W": "half-widths of the error of A and B, per second",
    "period": "s: A and B are valid at this rate only",
    "dead_time": "s, from when an input is written until the plant begins to answer: A and B are what follows then",
}
"""Comment of a field, on the line before it."""


def require_new(file: Path) -> None:
    """Raise `Refused` if a plant file cannot be written there."""
    if file.suffix != ".py":
        raise Refused(f"{file}: the name of a plant file must end in .py")
    if os.path.lexists(file):
        raise Refused(f"{file}: exists already and is not overwritten; choose another name")
    if not file.absolute().parent.is_dir():
        raise Refused(f"{file}: there is no folder {file.absolute().parent}")


def write_new(file: Path, text: str) -> None:
    """Write the file; raise `Refused` if that fails. Nothing is overwritten."""
    require_new(file)
    try:
        with file.open("x", encoding="utf-8") as opened:
            opened.write(text)
    except OSError as error:
        raise Refused(f"{file}: cannot be written: {error.strerror}") from error


def source(fields: Mapping[str, Any], about: Sequence[str]) -> str:
    """Return the text of a file in which PLANT is `Known.from_matrices(**fields)`.

    Args:
        fields: arguments of `Known.from_matrices`: arrays, tuples, mappings, texts, numbers; None is left out.
        about: lines of the file's docstring.
    """
    # Names may come from another person, and file names may be any bytes.
    lines = ['"""' + printable("\n".join(about)).replace("\\", "/").replace('"""', "'''") + '"""', ""]
    given = {key: _text(value, 4) for key, value in fields.items() if value is not None}
    if any("inf" in text for key, text in given.items() if key.endswith(("_min", "_max"))):
        lines += ["from math import inf", ""]
    lines += ["from lbmpc.plants import Known", "", "PLANT = Known.from_matrices("]
    for key, text in given.items():
        if key in COMMENTS:
            lines.append(f"    # {COMMENTS[key]}")
        lines.append(f"    {key}={text},")
    return "\n".join([*lines, ")", ""])


def shared_fields(known: Known) -> dict[str, Any]:
    """Fields that a model with other matrices shares with this one, as `from_matrices` takes them; names come first."""
    names = (
        *("name", "states", "inputs", "units", "x_e", "u_e", "x_min", "x_max", "u_min", "u_max"),
        *("u_rate_max", "x0", "safe_input", "safe_gain", "performance", "kernel", "poles"),
    )
    fields = {key: getattr(known, key) for key in names}
    fields |= {key: dict(getattr(known, key)) or None for key in ("scale", "names", "rows")}
    return fields | {"dead_time": known.dead_time or None}


def _text(value: Any, indent: int) -> str:
    """Python text of a value: matrices a row a line, floats with `DIGITS` digits, texts in double quotes."""
    if isinstance(value, np.ndarray) and value.ndim == 2:
        pad = " " * (indent + 4)
        rows = "".join(f"{pad}{_text(row, 0)},\n" for row in value)
        return f"[\n{rows}{' ' * indent}]"
    if isinstance(value, np.ndarray | list):
        return f"[{', '.join(_text(one, 0) for one in np.asarray(value).tolist())}]"
    if isinstance(value, Mapping):
        pairs = (f"{_text(key, 0)}: {_text(one, 0)}" for key, one in value.items())
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, tuple):
        return f"({', '.join(_text(one, 0) for one in value)}{',' if len(value) == 1 else ''})"
    if isinstance(value, float):
        return repr(float(f"{value:.{DIGITS}g}"))
    return _quoted(value) if isinstance(value, str) else repr(value)


def _quoted(text: str) -> str:
    """In double quotes unless it contains one; invisible characters are escaped."""
    after_single = repr("'" + text)
    return f'"{after_single[2:]}' if after_single.startswith('"') else repr(text)
