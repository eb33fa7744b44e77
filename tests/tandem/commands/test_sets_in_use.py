"""`tandem sets` at the command line, and runs with the tightening `invariant`, on a plant with quick sets."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from controller_node.build import build_model
from controller_node.certified_sets import SHIPPED, read_sets
from lbmpc.plants import PLANTS
from lbmpc.sets import construct as construction
from lbmpc.sets.certificate import model_of
from node_runtime.config.loading import load
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
from tests.helpers.plants.pendulum import PENDULUM
from tests.tandem.commands.pendulum_sets import OPTIONS, invariant, told

pytestmark = pytest.mark.usefixtures("known_pendulum")


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


def test_ctrl_c_loses_nothing_and_names_the_command_to_continue(
    cached: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    shutil.rmtree(cached / "cache")
    began: list[str] = []

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(construction, "controllable_sets", interrupted)
        assert main(["sets", "compute", *OPTIONS, "--out", "again.json"]) == 130
    assert "the same command continues from there" in capsys.readouterr().out
    assert not (cached / "again.json").exists()

    iterate = construction.predecessor_iteration

    def counted(*arguments: object, **named: object):
        began.append("iterate")
        return iterate(*arguments, **named)

    monkeypatch.setattr(construction, "predecessor_iteration", counted)
    assert main(["sets", "compute", *OPTIONS, "--out", "again.json"]) == 0
    assert not began
    again, before = read_sets(Path("again.json")), read_sets(Path("sets.json"))
    assert again.certificate == before.certificate


def test_a_plant_without_sets_gives_exit_code_3_and_a_remedy(
    cached: Path, capsys: pytest.CaptureFixture[str]
):
    options = [*OPTIONS, "--set", "controller.W=[5.0,10.0]"]
    assert main(["sets", "compute", *options, "--kind", "given", "--out", "none.json", "--json"]) == 3
    shown = capsys.readouterr()
    assert "may help" in json.loads(shown.out)["certificate"]
    assert "no certified sets of kind given" in shown.err
    assert not (cached / "none.json").exists()


def test_a_given_w_that_the_plant_leaves_is_reported(cached: Path, capsys: pytest.CaptureFixture[str]):
    options = [*OPTIONS, "--set", "controller.W=[1e-4,1e-4]"]
    assert main(["sets", "compute", *options, "--kind", "given", "--out", "given.json"]) == 0
    assert "Warning: the plant's own equations leave that W" in capsys.readouterr().out
    assert main(["sets", "check", "given.json", *OPTIONS]) == 3
    assert "its W does not contain h of the true plant: in piece C, from x =" in capsys.readouterr().err


def test_a_plant_of_numbers_has_sets_of_a_given_w(
    cached: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(PLANTS, "pendulum", PENDULUM.known())
    options = [*OPTIONS, "--set", "controller.W=[0.02,0.4]", "--set", "plant.x0=[0.3,0.0]"]
    assert main(["sets", "compute", *options, "--out", "box.json", "--kind", "box"]) == 3
    assert "numbers alone" in capsys.readouterr().err
    assert main(["sets", "compute", *options, "--out", "given.json", "--kind", "given"]) == 0
    assert "The plant has no equations with which to check this." in capsys.readouterr().out
    assert main(["sets", "check", "given.json", *options, "--json"]) == 0
    assert told(capsys)["W"].startswith("not checked: the plant has matrices only")
    # The sets are in use, the pendulum's equations are the truth, and the replay has numbers only.
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
    assert "h is in W: sampled at" in (shown := capsys.readouterr().out)
    assert "not proved" in shown


def test_without_sets_the_error_names_the_command_that_makes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ConfigError, match="tandem sets compute"):
        simulate(invariant(), 2)


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
    # The sets have an effect: without them the commands differ.
    assert not replay(read_run(log), overrides=["controller.tightening=first_step"]).equal


def test_a_log_without_its_sets_is_not_replayed_with_others(cached: Path):
    ran = simulate(invariant(), 5)
    del ran.streams[topics.SETS.name]
    with pytest.raises(LogError, match=r"certified sets .* are not in the log"):
        replay(ran)


def test_leaving_the_sets_and_the_return_are_reported_once(cached: Path):
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
