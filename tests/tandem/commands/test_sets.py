"""Which sets are trusted: edited and forged files, caches that others can write, and outputs."""

from __future__ import annotations

import gzip
import os
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from controller_node.certified_sets import (
    SHIPPED,
    SLACK,
    CertifiedSets,
    SavedArrays,
    Work,
    find_sets,
    read_sets,
    start_of,
    write_sets,
)
from lbmpc.sets import construct as construction
from lbmpc.sets.certificate import CertificateError
from lbmpc.sets.geometry.polytope import SetError
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from tandem.cli import main
from tandem.experiments.simulation.lockstep import simulate
from tests.helpers.plants.pendulum import pendulum
from tests.helpers.science import compressor
from tests.tandem.commands.pendulum_sets import OPTIONS, invariant

pytestmark = pytest.mark.usefixtures("known_pendulum")


def test_a_w_that_h_leaves_only_between_samples_is_refused(cached: Path, capsys: pytest.CaptureFixture[str]):
    """A few states in a corner of X suffice, although none of 100 samples is there."""
    sets = read_sets(cached / "sets.json")
    base = sets.certificate.pieces[0]
    W = np.array(base.W)
    smaller = msgspec.structs.replace(base, W=(W.mean(axis=0) + 0.97 * (W - W.mean(axis=0))).tolist())
    wrong = msgspec.structs.replace(sets.certificate, pieces=[smaller, *sets.certificate.pieces[1:]])
    write_sets(CertifiedSets.of(wrong, sets.found), cached / "wrong.json")
    assert main(["sets", "check", "wrong.json", *OPTIONS, "--no-prove", "--samples", "100"]) == 0
    assert main(["sets", "check", "wrong.json", *OPTIONS, "--samples", "100"]) == 3
    assert "its W is not proved for the true plant: in piece C, from x =" in capsys.readouterr().err


@pytest.mark.parametrize("at", [0.0, 0.003, 0.3, 0.7, 0.999])
def test_any_edited_byte_is_seen(cached: Path, capsys: pytest.CaptureFixture[str], at: float):
    file = cached / "sets.json"
    data = bytearray(file.read_bytes())
    place = int(at * len(data))
    data[place] = ord("7") if data[place] != ord("7") else ord("8")
    file.write_bytes(bytes(data))
    assert main(["sets", "check", "sets.json", *OPTIONS]) == 3
    with pytest.raises(ConfigError, match=r"controller.sets: sets\.json"):
        find_sets(invariant("controller.sets=sets.json"), pendulum())


def test_another_spelling_of_the_same_numbers_is_not_the_file(cached: Path):
    text = (cached / "sets.json").read_text()
    for edited in (text.replace(",", ", ", 1), text.replace("{", "{ ", 1)):
        with pytest.raises(CertificateError, match="edited"):
            CertifiedSets.from_bytes(edited.encode())


def test_a_wrong_claim_with_a_right_hash_is_refused(cached: Path, capsys: pytest.CaptureFixture[str]):
    sets = read_sets(cached / "sets.json")
    base = sets.certificate.pieces[0]
    wide = msgspec.structs.replace(base, g=[base.g[0] + 1e-3, *base.g[1:]])
    wrong = msgspec.structs.replace(sets.certificate, pieces=[wide, *sets.certificate.pieces[1:]])
    write_sets(CertifiedSets.of(wrong, sets.found), cached / "wrong.json")
    assert main(["sets", "check", "wrong.json", *OPTIONS]) == 3
    assert "the claim does not hold: piece 0 (C)" in capsys.readouterr().err


def test_another_model_is_refused_by_the_hash_that_differs(cached: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["sets", "check", "sets.json", *OPTIONS, "--set", "rate=12"]) == 3
    assert "for another model (period: sha256" in capsys.readouterr().err
    config = invariant("controller.sets=sets.json", "rate=12")
    with pytest.raises(
        ConfigError, match=r"sets\.json: the certificate is for another model .*period: sha256"
    ):
        simulate(config, 2)


def test_a_damaged_cache_counts_as_empty(tmp_path: Path):
    saved = SavedArrays(tmp_path)
    saved["stage"] = {"g": np.arange(3.0)}
    assert list(saved) == ["stage"]
    (tmp_path / "stage.npz").write_bytes(b"PK torn")
    assert "stage" not in saved


def test_the_cache_is_written_for_its_owner_alone_whatever_the_umask(cached: Path):
    found = [cached / "cache", *(cached / "cache").rglob("*")]
    assert {path.suffix for path in found} >= {".json", ".npz"}
    assert {stat.S_IMODE(path.lstat().st_mode) for path in found} == {0o700, 0o600}
    assert stat.S_IMODE((cached / "sets.json").stat().st_mode) & 0o044


def spoil(cached: Path, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the cache so that another user could have written it, or can write it."""
    folder = cached / "cache" / "tandem" / "sets"
    (file,) = folder.glob("*.json")
    if how == "folder":
        folder.chmod(0o775)
    elif how == "file":
        file.chmod(0o664)
    elif how == "link":
        file.rename(cached / "elsewhere.json")
        file.symlink_to(cached / "elsewhere.json")
    elif how == "above":
        (cached / "cache").chmod(0o777)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: cached.stat().st_uid + 1)


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("folder", r"can be written by others \(mode 0775\)"),
        ("file", r"can be written by others \(mode 0664\)"),
        ("link", "is a link"),
        ("above", "which all users can write to"),
        ("owner", "belongs to"),
    ],
)
def test_sets_that_another_user_could_have_written_are_not_used(
    cached: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str, says: str
):
    assert find_sets(invariant(), pendulum()).sha256 == read_sets(cached / "sets.json").sha256
    spoil(cached, how, monkeypatch)
    with pytest.raises(ConfigError, match=rf"{says}.*chmod -R go-w") as refused:
        find_sets(invariant(), pendulum())
    assert "tandem sets compute" in str(refused.value)
    before = sorted((cached / "cache").rglob("*"))
    monkeypatch.setattr(construction, "controllable_sets", lambda *_: [])
    monkeypatch.setattr(construction, "predecessor_iteration", _none)
    assert main(["sets", "compute", *OPTIONS, "--out", "again.json"]) == 3
    assert "not trusted" in (shown := " ".join(capsys.readouterr().out.split()))
    assert "computing without it" in shown
    assert sorted((cached / "cache").rglob("*")) == before


def _none(*_: object) -> None:
    raise SetError("begun anew")


def test_a_trusted_sensor_is_used_again(cached: Path, monkeypatch: pytest.MonkeyPatch):
    spoil(cached, "folder", monkeypatch)
    spoil(cached, "file", monkeypatch)
    for path in (cached / "cache").rglob("*"):
        path.chmod(path.stat().st_mode & ~0o022)
    assert find_sets(invariant(), pendulum()).found.contains_x0


def test_installed_sets_are_used_if_the_cache_is_not_trusted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    config, model = Config(), compressor()
    work = Work.of(model, "regions", start_of(config, model), None, SLACK, tmp_path)
    write_sets(read_sets(SHIPPED / "moore_greitzer-20Hz-regions.json.gz"), work.sets, 0o666)
    work.sets.chmod(0o666)
    assert find_sets(config, model, tmp_path).certificate.model.plant == "moore_greitzer"
    # A user's plant may have the same name and matrices, and another h.
    theirs = model.require_equations("this test")
    cubic = replace(theirs, rhs=lambda x, u: [dx + (x[0] - theirs.x_e[0]) ** 3 for dx in theirs.rhs(x, u)])
    for own in (replace(model, equations=cubic), replace(model, equations=None)):
        with pytest.raises(ConfigError, match="there are none for this plant"):
            find_sets(config, own, tmp_path)
    assert "chmod -R go-w" in caplog.text


def test_a_gzipped_file_is_the_same_sets(cached: Path):
    sets = read_sets(cached / "sets.json")
    write_sets(sets, cached / "sets.json.gz")
    assert gzip.decompress((cached / "sets.json.gz").read_bytes()) == (cached / "sets.json").read_bytes()
    assert read_sets(cached / "sets.json.gz").sha256 == sets.sha256
    (cached / "torn.json.gz").write_bytes((cached / "sets.json.gz").read_bytes()[:-20])
    with pytest.raises(CertificateError, match="damaged"):
        read_sets(cached / "torn.json.gz")


def test_a_small_file_cannot_unpack_to_any_size(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("controller_node.certified_sets.LARGEST", 10_000)
    with pytest.raises(CertificateError, match="after decompression"):
        CertifiedSets.from_bytes(gzip.compress(bytes(1_000_000)))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("elsewhere"), Path.mkdir])
def test_an_output_that_is_no_file_is_refused_before_anything_is_computed(
    make: Callable[[Path], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    make(tmp_path / "out")
    kind = (tmp_path / "out").lstat().st_mode
    assert main(["sets", "compute", *OPTIONS, "--out", str(tmp_path / "out")]) == 2
    assert "only regular files are read, replaced or moved" in capsys.readouterr().err
    assert (tmp_path / "out").lstat().st_mode == kind
    assert not (tmp_path / "cache").exists()


def test_a_pipe_as_a_file_of_sets_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "sets.json")
    with pytest.raises(CertificateError, match="it is a pipe"):
        read_sets(tmp_path / "sets.json")
