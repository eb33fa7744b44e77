"""`tandem sets` and the tightening `invariant` as a person meets them, on a plant with quick sets."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from controller_node.build import build_model
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
from lbmpc.plants import PLANTS
from lbmpc.sets import construct as construction
from lbmpc.sets.certificate import CertificateError, model_of
from lbmpc.sets.geometry.polytope import SetError
from node_runtime.config.loading import load
from node_runtime.config.sections import Config
from node_runtime.config.strict import ConfigError
from protocol import topics
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.replaying.replay import replay
from run_log.reporting.summary import summarise
from run_log.writing.save import save
from tandem.cli import main
from tandem.experiments.simulation.faults import Faults
from tandem.experiments.simulation.lockstep import follow, simulate
from tandem.live.monitor import Monitor
from tests.helpers.plants.pendulum import PENDULUM, pendulum
from tests.helpers.science import compressor

START = [0.62, 0.0]
SETTINGS = [
    *("plant.model=pendulum", f"plant.x0={START}", "rate=10", "controller.oracle=linear"),
    *("controller.horizon=10", "controller.solver.compile=never"),
]
OPTIONS = [word for setting in SETTINGS for word in ("--set", setting)]


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PLANTS, "pendulum", PENDULUM)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache that has the regions of the pendulum, made where groups share what they write."""
    home = tmp_path_factory.mktemp("home")
    before = os.umask(0o002)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PLANTS, "pendulum", PENDULUM)
        patch.setenv("XDG_CACHE_HOME", str(home / "cache"))
        try:
            assert main(["sets", "compute", *OPTIONS, "--out", str(home / "sets.json")]) == 0
        finally:
            os.umask(before)
    return home


@pytest.fixture
def cached(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it, with sets.json beside; the folder of the test."""
    shutil.copytree(home / "cache", tmp_path / "cache")
    shutil.copy(home / "sets.json", tmp_path / "sets.json")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def told(capsys: pytest.CaptureFixture[str]) -> dict:
    return json.loads(capsys.readouterr().out)


def invariant(*more: str) -> Config:
    return load(None, [*SETTINGS, "controller.tightening=invariant", *more])


def test_a_second_call_takes_the_sets_from_the_cache(cached: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["sets", "compute", *OPTIONS, "--out", "again.json", "--json"]) == 0
    result = told(capsys)
    assert result["cached"]
    assert result["certificate"] == "ok"
    assert result["contains_x0"]
    assert result["facets"] == sum(result["facets_by_set"]) > 10
    assert result["volume_fraction"] > 0.3
    assert result["invariance_margin"] > 0
    assert {"kind", "seconds", "file"} <= result.keys()
    assert (cached / "again.json").read_bytes() == (cached / "sets.json").read_bytes()


def test_ctrl_c_loses_nothing_and_says_how_to_go_on(
    cached: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    shutil.rmtree(cached / "cache")
    began: list[str] = []

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(construction, "controllable_sets", interrupted)
        assert main(["sets", "compute", *OPTIONS, "--out", "again.json"]) == 130
    assert "the same command goes on from there" in capsys.readouterr().out
    assert not (cached / "again.json").exists()

    iterate = construction.predecessor_iteration

    def counted(*arguments: object, **named: object):
        began.append("iterate")
        return iterate(*arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(construction, "predecessor_iteration", counted)
    assert main(["sets", "compute", *OPTIONS, "--out", "again.json"]) == 0
    assert not began
    again, before = read_sets(Path("again.json")), read_sets(Path("sets.json"))
    assert again.certificate == before.certificate


def test_a_plant_without_sets_ends_with_3_and_says_what_would_help(
    cached: Path, capsys: pytest.CaptureFixture[str]
):
    options = [*OPTIONS, "--set", "controller.W=[5.0,10.0]"]
    assert main(["sets", "compute", *options, "--kind", "given", "--out", "none.json", "--json"]) == 3
    shown = capsys.readouterr()
    assert "would help" in json.loads(shown.out)["certificate"]
    assert "no certified sets of kind given" in shown.err
    assert not (cached / "none.json").exists()


def test_a_given_w_that_the_plant_leaves_is_said(cached: Path, capsys: pytest.CaptureFixture[str]):
    options = [*OPTIONS, "--set", "controller.W=[1e-4,1e-4]"]
    assert main(["sets", "compute", *options, "--kind", "given", "--out", "given.json"]) == 0
    assert "Warning: the plant's own equations leave that W" in capsys.readouterr().out
    assert main(["sets", "check", "given.json", *OPTIONS]) == 3
    assert "its W does not hold for the true plant: in piece C, from x =" in capsys.readouterr().err


def test_numbers_alone_have_sets_of_a_given_w(
    cached: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(PLANTS, "pendulum", PENDULUM.known())
    options = [*OPTIONS, "--set", "controller.W=[0.02,0.4]", "--set", "plant.x0=[0.3,0.0]"]
    assert main(["sets", "compute", *options, "--out", "box.json", "--kind", "box"]) == 3
    assert "numbers alone" in capsys.readouterr().err
    assert main(["sets", "compute", *options, "--out", "given.json", "--kind", "given"]) == 0
    assert "There are no equations to hold it against." in capsys.readouterr().out
    assert main(["sets", "check", "given.json", *options, "--json"]) == 0
    assert told(capsys)["W"].startswith("not looked at: the plant is numbers alone")
    # In force, with the pendulum's equations as the truth, replayed from numbers.
    monkeypatch.setitem(PLANTS, "rod", replace(PENDULUM, name="rod"))
    config = invariant("controller.sets=given.json", "plant.truth=rod", "plant.x0=[0.3,0.0]")
    ran = follow(config, 30, Faults(command_seconds=0.03)).run
    assert summarise(ran).outside_ticks == 0
    save(ran, cached / "run.mcap")
    assert replay(read_run(cached / "run.mcap")).equal


def test_a_whole_file_passes(cached: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["sets", "check", "sets.json", *OPTIONS, "--json"]) == 0
    result = told(capsys)
    assert result["certificate"] == "ok"
    assert result["samples"] >= 20_000
    assert result["invariance_margin"] > 0
    assert result["W"].startswith("proved by interval arithmetic on")
    assert main(["sets", "check", "sets.json", *OPTIONS, "--no-prove"]) == 0
    assert "h stays in W: sampled at" in (shown := capsys.readouterr().out)
    assert "not proved" in shown


def test_a_w_that_samples_do_not_leave_and_h_does_is_refused(
    cached: Path, capsys: pytest.CaptureFixture[str]
):
    """A few states in a corner of X are enough, which none of 100 samples met."""
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
    assert "about another model (period: sha256" in capsys.readouterr().err
    config = invariant("controller.sets=sets.json", "rate=12")
    with pytest.raises(
        ConfigError, match=r"sets\.json: the certificate is about another model .*period: sha256"
    ):
        simulate(config, 2)


def test_without_sets_the_error_says_what_makes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ConfigError, match="tandem sets compute"):
        simulate(invariant(), 2)


def test_a_damaged_cache_is_as_good_as_none(tmp_path: Path):
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
    """The cache as somebody else could have written it, or may."""
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
        ("above", "which everybody can write"),
        ("owner", "belongs to"),
    ],
)
def test_sets_that_somebody_else_may_have_written_are_not_in_force(
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
    assert "not believed" in (shown := " ".join(capsys.readouterr().out.split()))
    assert "computed without it" in shown
    assert sorted((cached / "cache").rglob("*")) == before


def _none(*_: object) -> None:
    raise SetError("begun anew")


def test_what_is_believed_again_is_taken_again(cached: Path, monkeypatch: pytest.MonkeyPatch):
    spoil(cached, "folder", monkeypatch)
    spoil(cached, "file", monkeypatch)
    for path in (cached / "cache").rglob("*"):
        path.chmod(path.stat().st_mode & ~0o022)
    assert find_sets(invariant(), pendulum()).found.contains_x0


def test_sets_that_are_installed_are_in_force_where_the_cache_is_not_believed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    config, model = Config(), compressor()
    work = Work.of(model, "regions", start_of(config, model), None, SLACK, tmp_path)
    write_sets(read_sets(SHIPPED / "moore_greitzer-20Hz-regions.json.gz"), work.sets, 0o666)
    work.sets.chmod(0o666)
    assert find_sets(config, model, tmp_path).certificate.model.plant == "moore_greitzer"
    # Somebody's own plant may have the same name and matrices, and another h.
    theirs = model.require_equations("this test")
    cubic = replace(theirs, rhs=lambda x, u: [dx + (x[0] - theirs.x_e[0]) ** 3 for dx in theirs.rhs(x, u)])
    for own in (replace(model, equations=cubic), replace(model, equations=None)):
        with pytest.raises(ConfigError, match="none are there for this plant"):
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
    with pytest.raises(CertificateError, match="when unpacked"):
        CertifiedSets.from_bytes(gzip.compress(bytes(1_000_000)))


def test_a_run_is_replayed_from_its_log_alone(cached: Path):
    ran = simulate(invariant(), 30)
    summary = summarise(ran)
    assert summary.outside_ticks == 0
    assert summary.constraint_violations == 0
    assert summary.smallest_set_margin is not None
    assert summary.smallest_set_margin >= 0
    log = cached / "run.mcap"
    save(ran, log)
    shutil.rmtree(cached / "cache")
    again = replay(read_run(log))
    assert again.equal
    assert again.ticks == 30
    # Proof that the sets matter: without them the commands differ.
    assert not replay(read_run(log), overrides=["controller.tightening=first_step"]).equal


def test_a_log_without_its_sets_is_not_replayed_with_others(cached: Path):
    ran = simulate(invariant(), 5)
    del ran.streams[topics.SETS.name]
    with pytest.raises(LogError, match=r"certified sets .* are not in the log"):
        replay(ran)


def test_outside_is_said_once_and_so_is_the_way_back(cached: Path):
    ran = simulate(invariant(f"plant.x0={[0.8, 0.9]}", "controller.sets=sets.json"), 3)
    assert summarise(ran).outside_ticks == 3
    seen = Monitor(invariant(), PENDULUM, 1.0)
    result = ran.results[0]
    for seq, margin in enumerate([0.1, -0.2, -0.1, 0.1, 0.2]):
        seen._take(msgspec.structs.replace(result, seq=seq, set_margin=margin), float(seq))
    said = [event.text for event in seen.new_events()]
    assert said == [
        "tick 1: OUTSIDE the certified sets by 0.2: nothing is guaranteed",
        "tick 3: back in the certified sets after 2 ticks",
    ]
    assert seen.snapshot(4.0).outside == 2


def test_the_picture(cached: Path):
    assert main(["sets", "plot", "sets.json", "--out", "sets.png"]) == 0
    assert (cached / "sets.png").stat().st_size > 10_000


def test_the_shipped_sets_are_about_the_shipped_configuration():
    model = build_model(load(Path("configs/compressor.toml"), []))
    (file,) = SHIPPED.glob("moore_greitzer-20Hz-*")
    sets = read_sets(file)
    assert sets.found.contains_x0
    assert sets.certificate.certified
    # Another processor may round A in its last digit.
    mine = msgspec.to_builtins(model_of(model))
    its = msgspec.to_builtins(sets.certificate.model)
    assert mine.keys() == its.keys()
    assert (mine.pop("plant"), mine.pop("X"), mine.pop("U")) == (its.pop("plant"), its.pop("X"), its.pop("U"))
    for name, value in mine.items():
        np.testing.assert_allclose(value, its[name], rtol=1e-12, atol=1e-15)


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
    assert "only a regular file is read, replaced or moved" in capsys.readouterr().err
    assert (tmp_path / "out").lstat().st_mode == kind
    assert not (tmp_path / "cache").exists()


def test_a_pipe_as_a_file_of_sets_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "sets.json")
    with pytest.raises(CertificateError, match="it is a pipe"):
        read_sets(tmp_path / "sets.json")
