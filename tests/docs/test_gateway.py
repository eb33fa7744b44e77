"""The tables of docs/reference/gateway.md agree with the protocol: keys, sizes, fields and their types."""

from __future__ import annotations

import re

import msgspec
import pytest

from docs.generators.wire_types import words_of_field
from protocol import messages as m
from protocol import topics
from protocol.rights import rights_of
from protocol.topics import Topic
from tests.helpers.paths import DOCS

PAGE = (DOCS / "reference/gateway.md").read_text(encoding="utf-8")
SHOWN = (m.PlantState, m.Piece, m.Command, m.Backup, m.Override, m.Health)


def table(heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without the header row."""
    section = re.split(r"^#+ ", PAGE.split(f"\n{heading}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]
    rows = [line for line in section.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row.strip("|").split("|")] for row in rows[2:]]


@pytest.mark.parametrize("message", SHOWN, ids=lambda message: message.__name__)
def test_the_fields_of_a_message(message: type[msgspec.Struct]) -> None:
    expected = [
        [f"`{field.encode_name}`", words_of_field(field)] for field in msgspec.structs.fields(message)
    ]
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
