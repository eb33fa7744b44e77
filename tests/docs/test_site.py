"""The site builds: every link and anchor exists, every page is in the navigation, every docstring can be parsed."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest

from docs.generators import outside
from tests.helpers.paths import ROOT


def test_the_site_builds_without_a_warning_and_fetches_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("mkdocstrings")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    config = load_config("mkdocs.yml", site_dir=str(tmp_path), strict=False)
    with caplog.at_level(logging.WARNING, logger="mkdocs"):
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
    assert [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING] == []
    for page in tmp_path.rglob("*.html"):
        html = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:link|script|img|iframe)\b[^>]*?(?:href|src)="?(https?:[^\s">]+)', html)
        assert loaded == [], page


def test_links_out_of_docs_lead_to_pages_of_the_site() -> None:
    text = (
        "[a](../../examples/tanks/README.md) [b](../how/tick.md#times) ![c](../../examples/tanks/tanks.png)\n"
    )
    assert outside.with_site_links(text, "docs/tutorials/x.md") == (
        "[a](../examples/tanks/README.md) [b](../how/tick.md#times) ![c](../examples/tanks/tanks.png)\n"
    )
    assert outside.with_site_links("[p](tanks.py)\n", "examples/tanks/README.md") == "[p](tanks.py.md)\n"
    code = "```\n[a](../../examples)\n```\n"
    assert outside.with_site_links(code, "docs/tutorials/x.md") == code


def test_files_outside_docs_are_found_through_the_links_of_pages() -> None:
    pages = {"docs/tutorials/x.md": "[a](../../examples/tanks/README.md) [b](../../no/such/file.md)"}
    found = outside.linked_files(pages)
    assert {"examples/tanks/README.md", "examples/tanks/tanks.py", "examples/tanks/tanks.png"} <= set(found)
    assert not any(path.startswith("docs/") or "no/such" in path for path in found)


@pytest.mark.parametrize(
    "page", sorted((ROOT / "docs/decisions").glob("0*.md")), ids=lambda page: page.stem[:4]
)
def test_a_decision_has_its_status_in_the_index(page: Path) -> None:
    title, _, status = page.read_text(encoding="utf-8").splitlines()[:3]
    index = (page.parent / "index.md").read_text(encoding="utf-8")
    stated = re.match(r"(?:Accepted|Superseded|Withdrawn), \d{4}-\d\d-\d\d", status)
    assert stated is not None, status
    assert f"| {page.stem[:4]} | [{title.removeprefix('# ')}]({page.name}) | {stated[0]}" in index
