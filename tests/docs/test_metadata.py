"""The metadata of the repository agree: version, changes, citation, type information."""

from __future__ import annotations

import re
import tomllib

import pytest
import yaml

from tests.helpers.paths import INSTALLED, ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_is_in_the_changes_and_in_the_citation() -> None:
    version = PROJECT["project"]["version"]
    changes = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert changes[:2] == ["Unreleased", f"{version},"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == version
    assert [author["family-names"] for author in citation["preferred-citation"]["authors"]] == [
        "Gasparino",
        "Mishra",
        "Chowdhary",
    ]
    assert citation["preferred-citation"]["url"] == PROJECT["project"]["urls"]["Paper"]


@pytest.mark.parametrize("package", INSTALLED)
def test_the_package_declares_its_types(package: str) -> None:
    assert (ROOT / package / "py.typed").read_bytes() == b""


def test_the_hooks_before_a_commit_are_local() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    assert [repo["repo"] for repo in hooks["repos"]] == ["local"]
    entries = " ".join(hook["entry"] for hook in hooks["repos"][0]["hooks"])
    assert all(name in entries for name in ("ruff check", "ruff format", "mypy", "lint-imports"))


def test_the_page_of_the_installation_has_every_extra() -> None:
    page = (ROOT / "docs/start/install.md").read_text(encoding="utf-8")
    assert [name for name in PROJECT["project"]["optional-dependencies"] if f"| `{name}` |" not in page] == []
