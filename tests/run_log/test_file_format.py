"""A log begins with its format, and a reader refuses an unknown format with a message."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from run_log.errors import LogError
from run_log.file_format import FORMAT, IDENTITY, PROFILE, VERSIONS
from run_log.reading.reader import read_run
from run_log.reading.recover import recover
from tests.helpers.paths import CONFIGS
from tests.run_log.samples import synthetic, write


def log_of(path: Path, library: str) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=PROFILE, library=library)
        writer.finish()
    return path


def stated(path: Path) -> tuple[str, str]:
    """Return the library in the header, and the format in the metadata."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        (identity,) = (record for record in reader.iter_metadata() if record.name == IDENTITY)
        return reader.get_header().library, identity.metadata["format"]


def test_a_log_says_its_format_and_recovery_keeps_it(tmp_path: Path) -> None:
    config = override(Config(), ["log.chunk_bytes=8192"])
    whole = write(tmp_path / "run.mcap", config, synthetic(config, 30)[1])
    library, number = stated(whole)
    assert library.startswith("tandem log 3; mcap-python/")
    assert number == "3"
    cut, saved = tmp_path / "cut.mcap", tmp_path / "saved.mcap"
    cut.write_bytes(whole.read_bytes()[:-1000])
    recover(cut, saved)
    assert stated(saved) == (library, number)
    assert read_run(saved).ticks == read_run(whole).ticks


def test_a_log_of_a_newer_format_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = log_of(tmp_path / "x.mcap", f"tandem log {FORMAT + 1}; mcap-python/9.9")
    said = rf"x\.mcap: has the log format {FORMAT + 1}, and this version reads formats 2, 3; it needs the version"
    with pytest.raises(LogError, match=said):
        read_run(path)
    with pytest.raises(LogError, match=said):
        recover(path, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def test_a_log_of_an_older_format_names_the_version_that_reads_it(tmp_path: Path) -> None:
    path = log_of(tmp_path / "old.mcap", "tandem log 1; mcap-python/1.6.0")
    said = r"old\.mcap: has the log format 1, and this version reads formats 2, 3; Tandem 0\.1\.0 reads it"
    with pytest.raises(LogError, match=said):
        read_run(path)
    with pytest.raises(LogError, match=said):
        recover(path, tmp_path / "out.mcap")


def test_the_format_is_that_of_this_version_or_an_earlier_one() -> None:
    """The number increases together with the version of the next release."""
    ours = tomllib.loads((CONFIGS.parent / "pyproject.toml").read_text())["project"]["version"]
    assert [int(n) for n in VERSIONS[FORMAT].split(".")] <= [int(n) for n in ours.split(".")]


@pytest.mark.parametrize("library", ["", "tandem log", "tandem log one; x", "another; tandem log 1; x"])
def test_a_header_without_a_format_is_refused(tmp_path: Path, library: str) -> None:
    with pytest.raises(LogError, match="does not name a log format of Tandem"):
        read_run(log_of(tmp_path / "x.mcap", library))
