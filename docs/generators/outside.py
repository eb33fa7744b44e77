"""Files outside docs/ that pages link to: each becomes a page or a picture of the site, and the links lead there."""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# A link or picture of Markdown whose target is a path.
_LINK = re.compile(r"(?P<before>\]\()(?P<path>(?![a-z]+:|#|/)[^)#\s]+)")
_FENCE = re.compile(r"^(`{3,}).*?^\1`*[ \t]*$", re.DOTALL | re.MULTILINE)
_PICTURES = {".png", ".svg"}
_LANGUAGES = {".py": "python", ".toml": "toml", ".yml": "yaml", ".xml": "xml", ".c": "c", ".md": "markdown"}


def site_path(path: str) -> str:
    """Return where a file of the repository stands in the site, both relative to their roots."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return path if Path(path).suffix in _PICTURES | {".md"} else f"{path}.md"


def repository_path(uri: str) -> str:
    """Return the file of the repository that a path of the site stands for: the inverse of `site_path`."""
    if (ROOT / "docs" / uri).exists():
        return f"docs/{uri}"
    return uri if (ROOT / uri).exists() else uri.removesuffix(".md")


def links(text: str, page: str) -> Iterable[str]:
    """Yield the files of the repository that a page links to; a folder stands for its README.

    Args:
        text: the page's Markdown.
        page: its path in the repository.
    """
    for match in _LINK.finditer(_FENCE.sub("", text)):
        yield _target(match["path"], page)


def with_site_links(text: str, page: str) -> str:
    """Return a page's Markdown with every relative link as it must be in the site; code blocks stay as they are."""
    here = posixpath.dirname(site_path(page)) or "."

    def one(match: re.Match[str]) -> str:
        return match["before"] + posixpath.relpath(site_path(_target(match["path"], page)), here)

    parts, end = [], 0
    for fence in _FENCE.finditer(text):
        parts += [_LINK.sub(one, text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, _LINK.sub(one, text[end:])])


def linked_files(pages: Mapping[str, str]) -> list[str]:
    """Return all existing files outside docs/ that these pages link to, directly or through one another.

    Args:
        pages: Markdown by the path of the page in the repository; pages outside docs/ are among what is returned.
    """
    waiting = dict(pages)
    found = {page for page in waiting if not page.startswith("docs/")}
    while waiting:
        page, text = waiting.popitem()
        for target in links(text, page):
            if target in found or target.startswith(("docs/", "..")) or not (ROOT / target).is_file():
                continue
            found.add(target)
            if target.endswith(".md"):
                waiting[target] = as_page(target)
    return sorted(found)


def as_page(path: str) -> str:
    """Return a source file as a Markdown page."""
    file = ROOT / path
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".md":
        return text
    language = _LANGUAGES.get(file.suffix, "text")
    return f"# {file.name}\n\n`{path}` in the repository.\n\n````{language}\n{text.rstrip()}\n````\n"


def _target(link: str, page: str) -> str:
    target = posixpath.normpath(posixpath.join(posixpath.dirname(page), link))
    return f"{target}/README.md" if (ROOT / target).is_dir() else target
