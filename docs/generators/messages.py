"""The page of topics and messages, from `protocol`."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

import msgspec

from docs.generators.field_docs import cell, field_docs, own_doc, table
from docs.generators.wire_types import words_of_field
from protocol import messages, topics
from protocol.rights import ROLES, rights_of

HEAD = """# Topics and messages

This page is made from `protocol/topics.py`, `protocol/messages.py` and `protocol/rights.py`.
[The wire](gateway.md) explains the part of it that a gateway of your own needs.

A topic's full key is `tandem/<plant>/<topic>`. Every message is a msgpack map; its keys are the fields below.

## Topics

"""


def page() -> str:
    """Return the whole page."""
    shown = [cls for cls in vars(messages).values() if _is_message(cls)]
    parts = [
        HEAD,
        _topics(),
        "\n## Roles\n\n",
        _roles(),
        "\n## Messages\n\n",
        *(_message(cls) for cls in shown),
    ]
    return "".join(parts)


def _is_message(cls: object) -> bool:
    return isinstance(cls, type) and issubclass(cls, msgspec.Struct) and cls.__module__ == messages.__name__


def _topics() -> str:
    rows = []
    for topic in topics.ALL:
        readers = [role for role in ROLES if topic in rights_of(role).reads]
        rows.append(
            [
                f"`{topic.name}`",
                f"[{topic.type.__name__}](#{topic.type.__name__.lower()})",
                " → ".join([topic.writer, *([", ".join(readers)] if readers else [])]),
                topic.lane,
                _size(topic.max_bytes),
                _limits(topic),
            ]
        )
    head = ["topic", "message", "from → to", "lane", "largest", "limits"]
    above = f"{topics.BATCH_ABOVE_HZ:g}"
    return table(head, rows) + (
        "\n- **to** leaves out the roles that read everything.\n"
        "- **lane**: `control` is sent at once and dropped rather than queued. `bulk` blocks, on a session and a "
        "thread of its own.\n"
        "- **limits**: a faster loop publishes every n-th message only, or the log has views of fewer messages. "
        "The log holds the bytes of all.\n"
        f"- Above {above} Hz a loop sends what is only logged as a [Batch](#batch).\n"
    )


def _roles() -> str:
    rows = []
    for role in ROLES:
        rights = rights_of(role)
        reads = "everything" if rights.reads_all else _names(topic.name for topic in rights.reads)
        rows.append(
            [
                role,
                _names(_published(role)),
                reads,
                _names(rights.asks),
                _names(rights.answers),
            ]
        )
    return table(["role", "publishes", "reads", "asks", "answers"], rows)


def _published(role: str) -> list[str]:
    """Return the keys that a role publishes at, below the plant's; without those for a fast loop's direct messages."""
    keys = [key.removeprefix(topics.below("-", "")) for key in rights_of(role).publish_keys("-")]
    return [key for key in keys if not key.startswith(topics.DIRECT)]


def _message(cls: type[msgspec.Struct]) -> str:
    docs, is_message = field_docs(cls), issubclass(cls, messages.Message)
    shared = messages.Message.__struct_fields__ if is_message and cls is not messages.Message else ()
    rows = [
        [f"`{field.encode_name}`", cell(words_of_field(field)), cell(docs.get(field.name, ""))]
        for field in msgspec.structs.fields(cls)
        if field.name not in shared
    ]
    text = f"### {cls.__name__}\n\n{own_doc(cls)}\n\n{table(['field', 'type', 'meaning'], rows)}\n"
    return re.sub(r"\n{3,}", "\n\n", text)


def _names(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _size(most: int) -> str:
    return f"{most // 2**20} MiB" if most >= 2**20 else f"{most // 2**10} KiB"


def _limits(topic: topics.Topic) -> str:
    said = [(topic.max_hz, "messages"), (topic.view_hz, "views")]
    return ", ".join(f"{hz:g} {what}/s" for hz, what in said if not math.isinf(hz))
