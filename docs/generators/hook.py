"""What mkdocs calls while it builds the site; mkdocs.yml names this file."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

from docs.generators import outside
from docs.generators.generated import GENERATED

# Files outside docs/ that mkdocs.yml lists.
IN_THE_NAVIGATION = ("examples/README.md",)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace a folder in the navigation, such as `decisions/`, by its pages in the order of their names."""
    config.nav = [
        {title: _pages_of(value) if isinstance(value, str) and value.endswith("/") else value}
        for entry in config.nav or []
        for title, value in entry.items()
    ]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from the code, and the files outside docs/ that pages link to."""
    pages = {f"docs/{file.src_uri}": file.content_string for file in files.documentation_pages()}
    for uri, make in GENERATED.items():
        pages[f"docs/{uri}"] = make()
        files.append(File.generated(config, uri, content=pages[f"docs/{uri}"]))
    pages |= {path: outside.as_page(path) for path in IN_THE_NAVIGATION}
    for path in outside.linked_files(pages):
        uri = outside.site_path(path)
        if uri.endswith(".md"):
            level = InclusionLevel.INCLUDED if path in IN_THE_NAVIGATION else InclusionLevel.NOT_IN_NAV
            file = File.generated(config, uri, content=outside.as_page(path), inclusion=level)
        else:
            file = File.generated(config, uri, abs_src_path=str(outside.ROOT / path))
        files.append(file)
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links out of docs/ to where the linked file stands in the site."""
    uri = page.file.src_uri
    source = f"docs/{uri}" if uri in GENERATED else outside.repository_path(uri)
    return outside.with_site_links(markdown, source)


def _pages_of(folder: str) -> list[str]:
    return [
        f"{folder}{page.name}"
        for page in sorted((outside.ROOT / "docs" / folder).glob("*.md"), key=_first_index)
    ]


def _first_index(page: Path) -> tuple[bool, str]:
    return page.name != "index.md", page.name
