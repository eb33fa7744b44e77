"""A file's tables as typed Structs, strictly: what does not fit is named, with its place and the nearest right key."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import msgspec
import msgspec.inspect

from node_runtime.config import wording

Fail = Callable[[str, str], NoReturn]
"""(key, text): raises `ConfigError`."""
T = TypeVar("T", bound=msgspec.Struct)


class ConfigError(ValueError):
    """A configuration that cannot be used; the text says what, where and what would be right."""


def load_tree(path: str | Path | None) -> dict[str, Any]:
    """What a TOML file gives, unchecked; {} for None. Raises `ConfigError` for a file that cannot be read."""
    if path is None:
        return {}
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error


def apply_override(tree: dict[str, Any], assignment: str) -> str:
    """Put one `section.key=value` into a plain tree; returns the key. Raises `ConfigError`.

    The value is read as TOML (`0.5`, `[32, 32]`, `true`), and as a bare string where it is not.
    """
    key, separator, text = assignment.partition("=")
    key = key.strip()
    if not separator or not key:
        raise ConfigError(f"{assignment!r}: an override is written section.key=value")
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


def strict(tree: dict[str, Any], kind: type[T], where: str) -> T:
    """A plain tree as the Struct `kind`. Raises `ConfigError`, as helpful as for a configuration.

    where: the file, for messages.
    """
    return convert(tree, kind, failing(where, None))


def failing(where: str, origins: Mapping[str, str] | None) -> Fail:
    """What names the place of a mistake: the file, or for a key that came from elsewhere (`trainer.batch`) that."""

    def fail(key: str, text: str) -> NoReturn:
        place = key.split("[")[0]
        given = [origin for name, origin in (origins or {}).items() if f"{name}.".startswith(f"{place}.")]
        raise ConfigError(f"{given[-1] if given else where}: {text}")

    return fail


def convert(tree: dict[str, Any], kind: type[T], fail: Fail) -> T:
    """A plain tree as the Struct `kind`; calls `fail` with the key at fault and a text."""
    _reject_unknown(tree, _type_info(kind), fail, "")
    try:
        return msgspec.convert(tree, kind)
    except msgspec.ValidationError as error:
        key, text = wording.explain(str(error), tree, kind)
        fail(key, text)


@cache
def _type_info(kind: type) -> msgspec.inspect.Type:
    return msgspec.inspect.type_info(kind)


def _reject_unknown(value: Any, kind: msgspec.inspect.Type, fail: Fail, path: str) -> None:
    """msgspec would reject unknown keys too, but cannot say which key was meant."""
    match wording.without_none(kind), value:
        case msgspec.inspect.StructType(fields=known), dict():
            fields = {field.name: field.type for field in known}
            for key, below in value.items():
                full = f"{path}.{key}" if path else key
                if key not in fields:
                    near = difflib.get_close_matches(key, fields, n=1, cutoff=0.5)
                    hint = (
                        f"did you mean {(path + '.' if path else '') + near[0]!r}?"
                        if near
                        else f"known: {', '.join(fields)}"
                    )
                    fail(full, f"unknown key {full!r}; {hint}")
                _reject_unknown(below, fields[key], fail, full)
        case msgspec.inspect.ListType(item_type=item), list():
            for i, below in enumerate(value):
                _reject_unknown(below, item, fail, f"{path}[{i}]")
        case msgspec.inspect.DictType(value_type=item), dict():
            for key, below in value.items():
                _reject_unknown(below, item, fail, f"{path}.{key}")
