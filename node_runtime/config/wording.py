"""Says in a person's words why a configuration does not fit its types.

msgspec says "Expected `int` >= 1 - at `$.trainer.batch`"; a person wants the key, what was given and what
is allowed.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Any

import msgspec
from msgspec import inspect

_PLACE = re.compile(r"^(?P<text>.*) - at `\$\.?(?P<key>.*)`$", re.DOTALL)
_ABSENT = re.compile(r"missing required field `(\w+)`")
_STEP = re.compile(r"\[(\d+)\]|([^.\[\]]+)")


def nearest(name: str, names: Iterable[str]) -> str:
    """A hint for who misspelt one of these names: the one that was meant, or all that there are."""
    names = list(names)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"there are {', '.join(names) or 'none'}"


def explain(text: str, tree: Any, kind: type) -> tuple[str, str]:
    """The key at fault and a message for it.

    text: of a `msgspec.ValidationError` raised while `tree` was converted to the Struct `kind`.
    """
    found = _PLACE.match(text)
    if not found or not found["key"]:
        return "", text
    key = found["key"]
    value: Any = tree
    wanted: inspect.Type = inspect.type_info(kind)
    for index, name in _STEP.findall(key):
        wanted = without_none(wanted)
        if name and isinstance(wanted, inspect.StructType) and isinstance(value, dict):
            wanted = next(field.type for field in wanted.fields if field.name == name)
            value = value[name]
        elif index and isinstance(wanted, inspect.ListType) and isinstance(value, list):
            wanted, value = wanted.item_type, value[int(index)]
        else:  # a place that these types do not have: msgspec's own words are all there is
            return key, f"{key}: {found['text']}"
    wanted = without_none(wanted)
    if isinstance(wanted, inspect.LiteralType):
        choices = [str(choice) for choice in wanted.values]
        near = difflib.get_close_matches(str(value), choices, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        return key, f"{key} = {_shown(value)} is not one of {', '.join(choices)}{hint}"
    if absent := _ABSENT.search(found["text"]):
        return f"{key}.{absent[1]}", f"{key}.{absent[1]} is missing"
    if isinstance(wanted, inspect.StructType):
        return key, f"{key} = {_shown(value)} is a table: write [{key}] and its keys below"
    return key, f"{key} = {_shown(value)} is not {allowed(wanted)}"


def allowed(kind: inspect.Type) -> str:
    """What a value of this type may be: "an integer of at least 1 and at most 99"."""
    match kind:
        case inspect.BoolType():
            return "true or false"
        case inspect.IntType():
            return "an integer" + _range(kind)
        case inspect.FloatType():
            return "a number" + _range(kind)
        case inspect.StrType():
            return "a string" + (f" matching {kind.pattern}" if kind.pattern else "")
        case inspect.StructType():
            return f"a table with {', '.join(field.name for field in kind.fields)}"
        case inspect.ListType():
            return f"a list, each entry {allowed(without_none(kind.item_type))}"
    return f"a {type(kind).__name__.removesuffix('Type').lower()}"


def _range(kind: inspect.IntType | inspect.FloatType) -> str:
    bounds = [
        f"{words} {limit}"
        for words, limit in (
            ("above", kind.gt),
            ("of at least", kind.ge),
            ("below", kind.lt),
            ("at most", kind.le),
        )
        if limit is not None
    ]
    return " " + " and ".join(bounds) if bounds else ""


def without_none(kind: inspect.Type) -> inspect.Type:
    """The type proper of `T | None`."""
    if isinstance(kind, inspect.UnionType):
        rest = [option for option in kind.types if not isinstance(option, inspect.NoneType)]
        if len(rest) == 1:
            return rest[0]
    return kind


def _shown(value: object) -> str:
    text = (
        repr(value) if isinstance(value, str | float) else msgspec.json.encode(value, enc_hook=str).decode()
    )
    return text if len(text) <= 60 else text[:57] + "..."
