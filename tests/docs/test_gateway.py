"""The tables of docs/reference/gateway.md are what the protocol says: keys, sizes, fields and their types."""

from __future__ import annotations

import re
import typing

import msgspec
import pytest
from msgspec import inspect

from protocol import messages as m
from protocol import topics
from protocol.rights import rights_of
from protocol.topics import Topic
from tests.helpers.paths import DOCS

PAGE = (DOCS / "reference/gateway.md").read_text(encoding="utf-8")
SHOWN = (m.PlantState, m.Piece, m.Command, m.Backup, m.Override, m.Health)


def table(heading: str) -> list[list[str]]:
    """The cells of the first table below a heading, without its own head."""
    section = re.split(r"^#+ ", PAGE.split(f"\n{heading}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


def on_the_wire(kind: inspect.Type) -> str:
    """A field's type in the words of the page."""
    match kind:
        case inspect.Metadata(type=inner):
            return on_the_wire(inner)
        case inspect.UnionType(types=types):
            (some,) = (one for one in types if not isinstance(one, inspect.NoneType))
            return f"{on_the_wire(some)}, or nil"
        case inspect.StrType(min_length=None, max_length=None):
            return "str"
        case inspect.StrType(min_length=least, max_length=most):
            return f"str, {least} to {most} characters"
        case inspect.FloatType(gt=above, le=most) if above is not None and most is not None:
            return f"float, more than {above:g}, {most:g} at most"
        case inspect.IntType(ge=least) | inspect.FloatType(ge=least):
            name = "int" if isinstance(kind, inspect.IntType) else "float"
            return name if least is None else f"{name}, {least:g} or more"
        case inspect.ListType(item_type=item):
            return f"array of {on_the_wire(item)}"
        case inspect.DictType(key_type=key, value_type=value):
            return f"map from {on_the_wire(key)} to {on_the_wire(value)}"
        case inspect.StructType(cls=struct):
            return struct.__name__
        case inspect.LiteralType():
            # In the order of the source; `inspect` sorts them.
            raise TypeError("asked of the field's own annotation")
    raise TypeError(f"the page has no words for {kind}")


def type_of(field: msgspec.structs.FieldInfo) -> str:
    if field.default is msgspec.UNSET:
        (given,) = (one for one in typing.get_args(field.type) if one is not msgspec.UnsetType)
        return f"{on_the_wire(inspect.type_info(given))}; may be left out"
    values = getattr(field.type, "__args__", ())
    if values and all(isinstance(value, str) for value in values):
        quoted = [f'"{value}"' for value in values]
        return f"{', '.join(quoted[:-1])} or {quoted[-1]}"
    text = on_the_wire(inspect.type_info(field.type))
    default = "empty" if field.default in (msgspec.NODEFAULT, []) else f"{field.default:g}"
    return text if field.required else f"{text}; may be left out: {default}"


@pytest.mark.parametrize("message", SHOWN, ids=lambda message: message.__name__)
def test_the_fields_of_a_message(message: type[msgspec.Struct]) -> None:
    expected = [[f"`{field.encode_name}`", type_of(field)] for field in msgspec.structs.fields(message)]
    assert sorted(row[:2] for row in table(f"### {message.__name__}")) == sorted(expected)


def test_the_keys_and_sizes() -> None:
    rights = rights_of("plant")
    assert (rights.reads_all, rights.asks, rights.answers) == (False, (), ())

    def row(topic: Topic, does: str) -> list[str]:
        return [f"`{topic.name}`", f"`{topic.type.__name__}`", does, str(topic.max_bytes)]

    expected = [row(topic, "publishes") for topic in rights.publishes]
    expected += [row(topic, "subscribes") for topic in rights.reads]
    shown = [[*row[:3], row[4]] for row in table("## Connection")]
    assert sorted(shown) == sorted(expected)


def test_from_which_rate_on_commands_travel_apart() -> None:
    assert f"**Above {topics.BATCH_ABOVE_HZ:g} Hz**" in PAGE
    for topic in (topics.COMMAND, topics.BACKUP):
        assert (topic.batched_at(topics.BATCH_ABOVE_HZ + 1), topic.lane) == (topic.batched, "control")
    assert topics.COMMAND.direct_key("jet1") == "tandem/jet1/@direct/controller/command"
