"""The reference is generated from the code and describes every key, field and option."""

from __future__ import annotations

import re

import pytest

from docs.generators import cli, configuration, messages
from protocol import topics
from tandem.cli import AnyCommand
from tests.helpers.paths import ROOT


def test_every_key_of_the_configuration_has_a_meaning() -> None:
    without = [
        f"{name}.{key.name}"
        for name, cls in configuration.sections()
        for key in configuration.keys(cls)
        if not configuration.field_docs(cls).get(key.name)
    ]
    assert without == []


def test_the_page_of_the_configuration_has_every_key_of_the_shipped_file() -> None:
    page = configuration.page()
    for name, cls in configuration.sections():
        section = page.split(f"## [{name}]" if name else "## Top level", 1)[1].split("\n## ", 1)[0]
        for key in configuration.keys(cls):
            assert f"| `{key.name}` |" in section
    assert "| `20.0` | Hz | number > 0 |" in page
    assert "|  | s | number ≥ 0 |" in page


def test_no_section_is_left_out() -> None:
    text = (ROOT / "configs/compressor.toml").read_text(encoding="utf-8")
    tables = re.findall(r"^\[([\w.]+)\]", text, re.MULTILINE)
    assert {name for name, _ in configuration.sections()} == {"", *tables}


def test_every_command_is_on_the_page_with_its_options() -> None:
    page = cli.page()
    for words, read in cli.commands():
        assert f"tandem {' '.join(words)}".strip() in page
        assert read.text, f"{words}: no description"
        assert all(meaning for _, meaning in read.options)
    assert page.count("\n## tandem ") == len(AnyCommand.__args__)
    assert re.search(r"\| `--seconds S` \| .+ \| 20; with --no-plant until Ctrl-C \|", page)
    assert "<code>--config NAME&#124;FILE</code>" in page


def test_a_help_text_is_read_by_its_boxes() -> None:
    read = cli.read_help(cli.printed_help(("replay",)))
    assert read.usage.startswith("tandem replay")
    assert [name for name, _ in read.options if not name.startswith("-")] == ["FILE"]
    assert dict(read.options)["--architecture FILE:NAME"].endswith("(default: none)")


def test_every_role_is_on_the_page_with_what_it_publishes() -> None:
    page = messages.page()
    assert "| viewer |  | everything |" in page
    assert "| user | `user/**` |" in page
    assert "| commander | `operator/reference`, `operator/override` | everything |" in page


@pytest.mark.parametrize("topic", topics.ALL, ids=lambda topic: topic.name)
def test_every_topic_and_its_message_is_on_the_page(topic: topics.Topic) -> None:
    page = messages.page()
    assert (
        f"| `{topic.name}` | [{topic.type.__name__}](#{topic.type.__name__.lower()}) | {topic.writer}" in page
    )
    fields = page.split(f"### {topic.type.__name__}\n", 1)[1].split("\n### ", 1)[0]
    own = [name for name in topic.type.__struct_encode_fields__ if name not in ("run_id", "seq")]
    assert all(f"| `{name}` |" in fields for name in own)
