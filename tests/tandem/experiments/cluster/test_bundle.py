"""The files that a sweep sends to workers, and the configuration with their paths there."""

from __future__ import annotations

from pathlib import Path

import pytest

from node_runtime.config.loading import from_tree
from node_runtime.config.plant import files_of
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from tandem.experiments.cluster import bundle
from tandem.experiments.cluster.bundle import Bundle, gather, moved, unpack


def config(folder: Path, **tree: object) -> Config:
    return from_tree(tree, folder=folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "client" / "tanks"
    folder.mkdir(parents=True)
    (folder / "tanks.py").write_text("TANKS = 1\n")
    (folder / "neighbour.py").write_text("X = 1\n")
    (folder / "data.xml").write_text("<x/>\n")
    (folder / ".secret").write_text("key\n")
    (folder / "runs").mkdir()
    (folder / "runs" / "large.bin").write_text("large\n")
    return folder


def test_the_folder_of_a_file_with_code_travels_without_hidden_files_and_folders(folder: Path) -> None:
    found = gather([config(folder, plant={"model": "tanks.py:TANKS"}), config(folder)])
    assert {name: sorted(files) for name, files in found.folders.items()} == {
        str(folder): ["data.xml", "neighbour.py", "tanks.py"]
    }


def test_every_reference_finds_its_file_where_it_was_unpacked(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "client" / "nets"
    other.mkdir()
    (other / "tanks.py").write_text("another of the same name\n")
    (other / "certified.npz").write_bytes(b"sets")
    asked = config(
        folder,
        plant={"model": "tanks.py:TANKS", "truth": "tanks.py"},
        network={"architecture": f"{other}/tanks.py:GRU"},
        controller={"tightening": "invariant", "sets": str(other / "certified.npz")},
    )
    root = tmp_path / "worker"
    unpack(gather([asked]), root)
    here = moved(asked, root)
    assert files_of(here) == files_of(asked)
    assert len(files_of(here)) == 3
    for text in (here.plant.model, here.plant.truth, here.network.architecture, here.controller.sets):
        assert str(text).startswith(str(root))
    assert here.plant.model.endswith("tanks.py:TANKS")
    assert Path(str(here.controller.sets)).read_bytes() == b"sets"
    # Only the file of certified sets is sent; here its folder also contains a file with code.
    assert moved(config(folder), root) == config(folder)


def test_packages_and_shipped_plants_stay_as_they_are(folder: Path, tmp_path: Path) -> None:
    asked = config(folder, plant={"model": "mypackage.plants:TANKS"})
    assert gather([asked]).folders == {}
    assert moved(asked, tmp_path) == asked


def test_a_folder_that_is_too_large_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "LARGEST", 10)
    with pytest.raises(ConfigError, match=f"{folder}: its files must be sent .* folder of its own"):
        gather([config(folder, plant={"model": "tanks.py:TANKS"})])


def test_certified_sets_must_be_named_for_a_cluster(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"name their file, controller\.sets"):
        gather([config(folder, controller={"tightening": "invariant"})])


def test_a_name_that_leads_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is not the name of a file"):
        unpack(Bundle({"x": {"../../escaped": b""}}), tmp_path / "worker")


def test_the_same_files_have_the_same_hash_whatever_their_order() -> None:
    one, other = Bundle({"a": {"x": b"1", "y": b"2"}}), Bundle({"a": {"y": b"2", "x": b"1"}})
    assert one.sha256 == other.sha256 != Bundle({"a": {"x": b"1", "y": b"3"}}).sha256
