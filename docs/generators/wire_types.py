"""What a field of a message is on the wire, in words."""

from __future__ import annotations

import typing

import msgspec
from msgspec import inspect


def words_of_field(field: msgspec.structs.FieldInfo) -> str:
    """Return a field's type, and what stands for it where it may be left out."""
    if field.default is msgspec.UNSET:
        (given,) = (one for one in typing.get_args(field.type) if one is not msgspec.UnsetType)
        return f"{words_of_type(inspect.type_info(given))}; may be left out"
    values = getattr(field.type, "__args__", ())
    if values and all(isinstance(value, str) for value in values):
        # In the order of the source; `inspect` sorts them.
        quoted = [f'"{value}"' for value in values]
        text = f"{', '.join(quoted[:-1])} or {quoted[-1]}"
    else:
        text = words_of_type(inspect.type_info(field.type))
    return text if field.required else f"{text}; may be left out: {_default(field)}"


def words_of_type(kind: inspect.Type) -> str:
    """Return a type in words."""
    match kind:
        case inspect.Metadata(type=inner):
            return words_of_type(inner)
        case inspect.UnionType(types=types):
            (some,) = (one for one in types if not isinstance(one, inspect.NoneType))
            return f"{words_of_type(some)}, or nil"
        case inspect.BytesType():
            return "bin"
        case inspect.StrType(min_length=None, max_length=None):
            return "str"
        case inspect.StrType(min_length=None, max_length=most):
            return f"str, {most} characters at most"
        case inspect.StrType(min_length=least, max_length=most):
            return f"str, {least} to {most} characters"
        case inspect.FloatType(gt=above, le=most) if above is not None and most is not None:
            return f"float, more than {above:g}, {most:g} at most"
        case inspect.IntType(ge=least) | inspect.FloatType(ge=least):
            name = "int" if isinstance(kind, inspect.IntType) else "float"
            return name if least is None else f"{name}, {least:g} or more"
        case inspect.ListType(item_type=item):
            return f"array of {words_of_type(item)}"
        case inspect.DictType(key_type=key, value_type=value):
            return f"map from {words_of_type(key)} to {words_of_type(value)}"
        case inspect.StructType(cls=struct):
            return struct.__name__
        case inspect.BoolType():
            return "bool"
        case inspect.LiteralType(values=values):
            return " or ".join(f'"{value}"' for value in values)
    raise TypeError(f"there are no words for {kind}")


def _default(field: msgspec.structs.FieldInfo) -> str:
    if field.default is None:
        return "nil"
    if isinstance(field.default, str):
        return f'"{field.default}"' if field.default else "empty"
    if field.default is msgspec.NODEFAULT or field.default in ([], {}):
        return "empty"
    return f"{field.default:g}"
