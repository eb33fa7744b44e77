"""The page of the configuration: every section and key, from `node_runtime.config.sections`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import inspect

from docs.generators.field_docs import cell, field_docs, own_doc, table
from node_runtime.config.sections import Config, PlantPlace, Section

LARGEST_SHOWN = 10_000
HEAD = """# Configuration

This page is made from `node_runtime/config/sections.py`.

A configuration is a TOML file. Every key has a default, so a file names only what differs. `--config FILE` gives a file
to a command, and `--set section.key=value` changes one value. `tandem config show` prints the resolved configuration.
[configs/compressor.toml](../../configs/compressor.toml) has all keys with comments.

Half-widths are half the distance between the bounds of a state or input. The plant's `time_scale` is that of its
slowest mode under the feedback K.

"""


def page() -> str:
    """Return the whole page."""
    return HEAD + "\n\n".join(_section(name, cls) for name, cls in sections())


def sections(cls: type[Section] = Config, name: str = "") -> Iterator[tuple[str, type[Section]]]:
    """Yield every table of the configuration, (name, class); the top level has the name ""."""
    yield name, cls
    for field in msgspec.structs.fields(cls):
        if isinstance(field.default, Section):
            yield from sections(type(field.default), f"{name}.{field.name}" if name else field.name)


def keys(cls: type[Section]) -> list[msgspec.structs.FieldInfo]:
    """Return the keys of a table, without the tables below it."""
    return [field for field in msgspec.structs.fields(cls) if not isinstance(field.default, Section)]


def words_of_type(kind: inspect.Type) -> str:
    """Return what a value of this type may be."""
    match kind:
        case inspect.Metadata(type=inner):
            return words_of_type(inner)
        case inspect.UnionType(types=types):
            return " or ".join(words_of_type(one) for one in types if not isinstance(one, inspect.NoneType))
        case inspect.BoolType():
            return "true or false"
        case inspect.IntType():
            return f"integer{_limits(kind)}"
        case inspect.FloatType():
            return f"number{_limits(kind)}"
        case inspect.StrType():
            return "text"
        case inspect.LiteralType(values=values):
            return ", ".join(f"`{value}`" for value in values)
        case inspect.ListType(item_type=item):
            return f"list of {words_of_type(item)}"
        case inspect.DictType(value_type=value):
            return f"table of {words_of_type(value)} by name"
        case inspect.StructType(cls=struct):
            return f"table ({', '.join(f'`{name}`' for name in struct.__struct_fields__)})"
    raise TypeError(f"there are no words for {kind}")


def unit_of(kind: inspect.Type) -> str:
    """Return the unit of a value of this type, "" where it has none."""
    match kind:
        case inspect.Metadata(type=inner, extra=extra):
            return (extra or {}).get("unit") or unit_of(inner)
        case inspect.UnionType(types=types):
            return next(filter(None, map(unit_of, types)), "")
        case inspect.ListType(item_type=item) | inspect.DictType(value_type=item):
            return unit_of(item)
    return ""


def _section(name: str, cls: type[Section]) -> str:
    docs = field_docs(cls)
    rows = []
    for field in keys(cls):
        kind = inspect.type_info(field.type)
        text = docs.get(field.name, "")
        cells = [cell(text), cell(_default(field)), unit_of(kind), cell(words_of_type(kind))]
        rows.append([f"`{field.name}`", *cells])
    title = f"[{name}]" if name else "Top level"
    parts = [f"## {title}", own_doc(cls), table(["key", "meaning", "default", "unit", "type"], rows)]
    if name == "trainer":
        parts += [f"One entry of `fleet`: {own_doc(PlantPlace)}", _entry(PlantPlace)]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


def _entry(cls: type[Section]) -> str:
    docs = field_docs(cls)
    rows = [
        [
            f"`{field.name}`",
            cell(words_of_type(inspect.type_info(field.type))),
            cell(docs.get(field.name, "")),
        ]
        for field in msgspec.structs.fields(cls)
    ]
    return table(["key", "type", "meaning"], rows)


def _default(field: msgspec.structs.FieldInfo) -> str:
    value: Any = field.default
    if field.default_factory is not msgspec.NODEFAULT:
        value = field.default_factory()
    if value is None:
        return ""
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    return f"`{value}`"


def _limits(kind: inspect.IntType | inspect.FloatType) -> str:
    # Most upper limits only keep memory and time bounded.
    most = kind.le if kind.le is not None and kind.le <= LARGEST_SHOWN else None
    said = [(">", kind.gt), ("≥", kind.ge), ("<", kind.lt), ("≤", most)]
    text = ", ".join(f"{sign} {limit:g}" for sign, limit in said if limit is not None)
    return f" {text}" if text else ""
