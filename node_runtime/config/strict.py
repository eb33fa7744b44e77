"""Strict conversion of a file's tables to typed Structs, with error messages for a person.

The text of msgspec is like "Expected `int` >= 1 - at `$.trainer.batch`". It is replaced by the key, the given value,
its place, and the allowed values.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import msgspec
from msgspec import inspect

Fail = Callable[[str, str], NoReturn]
"""Takes a key and a text, and raises `ConfigError`."""
T = TypeVar("T", bound=msgspec.Struct)

_PLACE = re.compile(r"^(?P<text>.*) - at `\$\.?(?P<key>.*)`$", re.DOTALL)
_ABSENT = re.compile(r"missing required field `(\w+)`")
_STEP = re.compile(r"\[(\d+)\]|([^.\[\]]+)")


class ConfigError(ValueError):
    """The configuration cannot be used. The text says what, where, and what is allowed."""


def load_tree(path: str | Path) -> dict[str, Any]:
    """Read a TOML file without checks. Raises `ConfigError` if it cannot be read."""
    try:
        # Editors on Windows write a byte order mark, which TOML does not allow.
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: not valid TOML: it is not UTF-8 text; save it as UTF-8 ({error})"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error


def apply_override(tree: dict[str, Any], assignment: str) -> str:
    """Put one `section.key=value` into a plain tree and return the key. Raises `ConfigError`.

    The value is read as TOML (`0.5`, `[32, 32]`, `true`), or as a plain string if it is not TOML.
    """
    key, separator, text = assignment.partition("=")
    key = key.strip()
    if not separator or not key:
        raise ConfigError(f"{assignment!r}: write an override as section.key=value")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    *tables, last = key.split(".")
    for table in tables:
        child = tree.setdefault(table, {})
        if not isinstance(child, dict):
            raise ConfigError(f"{assignment!r}: {table} is a value, not a table")
        tree = child
    tree[last] = value
    return key


def readable(text: str) -> str:
    """Return text that UTF-8 can encode. Bytes of a file name that are not text become \\udcXX."""
    return text.encode(errors="backslashreplace").decode()


def strict(tree: dict[str, Any], kind: type[T], where: str) -> T:
    """Convert a plain tree to the Struct `kind`. Raises `ConfigError` with the same details as for a configuration.

    where: the file's name for messages.
    """
    return convert(tree, kind, failing(where))


def failing(where: str, origins: Mapping[str, str] | None = None) -> Fail:
    """Return a function that raises `ConfigError` with the place of a key: the file, or its entry in `origins`."""

    def fail(key: str, text: str) -> NoReturn:
        place = key.split("[")[0]
        given = [origin for name, origin in (origins or {}).items() if f"{name}.".startswith(f"{place}.")]
        raise ConfigError(f"{given[-1] if given else where}: {text}")

    return fail


def convert(tree: dict[str, Any], kind: type[T], fail: Fail) -> T:
    """Convert a plain tree to the Struct `kind`; call `fail` with the wrong key and a text."""
    _reject_unknown(tree, _type_info(kind), fail, "")
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        fail(*_explain(str(error), tree, kind))


def did_you_mean(given: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """Return a hint for a misspelt name: the nearest known name, after `prefix`, or else `otherwise`."""
    near = difflib.get_close_matches(given, known, n=1, cutoff=0.5)
    return f"did you mean {prefix + near[0]!r}?" if near else otherwise


@cache
def _type_info(kind: type) -> inspect.Type:
    return inspect.type_info(kind)


def _reject_unknown(value: Any, kind: inspect.Type, fail: Fail, path: str) -> None:
    """Report unknown keys. msgspec rejects them too, but does not suggest the nearest one."""
    within = f"{path}." if path else ""
    match _bare(kind), value:
        case inspect.StructType(fields=fields), dict():
            known = {field.name: field.type for field in fields}
            for key, below in value.items():
                if key not in known:
                    hint = did_you_mean(key, known, f"known: {', '.join(known)}", within)
                    fail(within + key, f"unknown key {within + key!r}; {hint}")
                _reject_unknown(below, known[key], fail, within + key)
        case inspect.ListType(item_type=item), list():
            for i, below in enumerate(value):
                _reject_unknown(below, item, fail, f"{path}[{i}]")
        case inspect.DictType(value_type=item), dict():
            for key, below in value.items():
                _reject_unknown(below, item, fail, within + key)


def _explain(text: str, tree: Any, kind: type) -> tuple[str, str]:
    """Return the wrong key and a message for it.

    text: that of a `msgspec.ValidationError` raised while `tree` was converted to the Struct `kind`.
    """
    found = _PLACE.match(text)
    if not found or not found["key"]:
        return "", text
    # msgspec does not name the entry of a table.
    key = found["key"].partition("[...]")[0]
    value: Any = tree
    wanted = _type_info(kind)
    for index, name in _STEP.findall(key):
        match wanted, value:
            case inspect.StructType(fields=fields), dict() if name:
                wanted = next(field.type for field in fields if field.name == name)
                value = value[name]
            case inspect.ListType(item_type=item), list() if index:
                wanted, value = item, value[int(index)]
            case _:  # a place outside these types: use msgspec's text
                return key, f"{key}: {found['text']}"
        wanted = _bare(wanted)
    given = f"{key} = {_shown(value)}"
    if isinstance(wanted, inspect.LiteralType):
        choices = [str(choice) for choice in wanted.values]
        hint = did_you_mean(str(value), choices, "")
        return key, f"{given} is not one of {', '.join(choices)}{hint and f'; {hint}'}"
    if absent := _ABSENT.search(found["text"]):
        return f"{key}.{absent[1]}", f"{key}.{absent[1]} is missing"
    if isinstance(wanted, inspect.StructType):
        return key, f"{given} is a table: write [{key}] and its keys below"
    return key, f"{given} is not {_allowed(wanted)}"


def _allowed(kind: inspect.Type) -> str:
    """Describe the allowed values of a type, such as "an integer of at least 1 and at most 99"."""
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
            length = (
                f" of {kind.min_length}" if kind.min_length and kind.min_length == kind.max_length else ""
            )
            return f"a list{length}, each entry {_allowed(_bare(kind.item_type))}"
        case inspect.DictType():
            return f"a table, each entry {_allowed(_bare(kind.value_type))}"
        case inspect.UnionType(types=types):
            return " or ".join(_allowed(_bare(option)) for option in types)
    return f"a {type(kind).__name__.removesuffix('Type').lower()}"


def _range(kind: inspect.IntType | inspect.FloatType) -> str:
    bounds = ("above", kind.gt), ("of at least", kind.ge), ("below", kind.lt), ("at most", kind.le)
    said = " and ".join(f"{words} {limit}" for words, limit in bounds if limit is not None)
    return said and f" {said}"


def _bare(kind: inspect.Type) -> inspect.Type:
    """Return T of `T | None`, without the unit that it may have."""
    if isinstance(kind, inspect.Metadata):
        return _bare(kind.type)
    if isinstance(kind, inspect.UnionType):
        rest = [option for option in kind.types if not isinstance(option, inspect.NoneType)]
        if len(rest) == 1:
            return _bare(rest[0])
    return kind


def _shown(value: object) -> str:
    plain = isinstance(value, str | float)
    text = repr(value) if plain else msgspec.json.encode(value, enc_hook=str).decode()
    return text if len(text) <= 60 else text[:57] + "..."
