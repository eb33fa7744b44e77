"""`pip install` installs the packages with their data and the shipped configurations, and nothing else."""

from __future__ import annotations

import tomllib
import zipfile
from pathlib import Path

import pytest

from controller_node.certified_sets import read_sets
from node_runtime.config.shipped import shipped
from tests.helpers.paths import CONFIGS, ROOT
from tests.packaging.wheel import INSTALLED, build_wheel, copy_sources, unpacked_sdist


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copy_sources(tmp_path_factory.mktemp("sources"))


@pytest.fixture(scope="module")
def expected(sources: Path) -> set[str]:
    """Return every file of the packages, and the files of configs/ also as data of tandem."""
    files = {path for name in INSTALLED for path in (sources / name).rglob("*") if path.is_file()}
    configs = {f"tandem/configs/{path.relative_to(CONFIGS)}" for path in CONFIGS.rglob("*") if path.is_file()}
    return {str(path.relative_to(sources)) for path in files} | configs


@pytest.fixture(scope="module")
def wheel(sources: Path, expected: set[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(sources, tmp_path_factory.mktemp("built") / "wheel")


def content(wheel: Path) -> set[str]:
    """Return the files of a wheel without its metadata."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def test_the_wheel_holds_every_file_of_its_packages_and_no_other(wheel: Path, expected: set[str]):
    assert content(wheel) == expected
    assert "tandem/configs/compressor.toml" in expected
    assert "tandem/experiments/reporting/page.html.j2" in expected


def test_a_wheel_by_way_of_the_source_distribution_is_the_same(
    sources: Path, expected: set[str], tmp_path: Path
):
    unpacked = unpacked_sdist(sources, tmp_path / "sdist")
    assert content(build_wheel(unpacked, tmp_path / "wheel")) == expected


def test_the_wheel_declares_its_extras(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        said = archive.read(name).decode().splitlines()
    extras = {line.partition(": ")[2] for line in said if line.startswith("Provides-Extra: ")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert extras == set(project["optional-dependencies"])


def test_shipped_files_are_found_through_the_link():
    assert (shipped("experiments") / "paper.toml").read_bytes() == (
        CONFIGS / "experiments" / "paper.toml"
    ).read_bytes()
    assert all(read_sets(path).certificate.certified for path in shipped("sets").iterdir())
