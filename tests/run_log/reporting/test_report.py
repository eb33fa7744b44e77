"""Figures and pictures of a run from its log alone."""

from __future__ import annotations

import dataclasses
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure

from lbmpc import plants
from lbmpc.plants import get_plant
from node_runtime.config.loading import override
from node_runtime.config.sections import Config
from protocol import topics
from protocol.messages import InputSource, Tick
from run_log.errors import LogError
from run_log.reading.reader import read_run
from run_log.reporting import plots
from run_log.reporting.canvas import save
from run_log.reporting.motion import trajectory
from run_log.reporting.report import picture, report
from run_log.reporting.summary import PredictionError, summarise
from run_log.reporting.traces import Traces, traces
from run_log.run import gather
from tests.helpers.interpreter import imported
from tests.run_log.samples import STEPS, Logged

PLANT = get_plant("moore_greitzer")


def test_names_and_units_are_no_formulas(config: Config, messages: list[Logged]) -> None:
    data = traces(gather(config, messages))
    odd = {"states": (r"a$x_\frac$", "b$", r"\$c$$", "d"), "units": {"d": "$"}}
    data = dataclasses.replace(data, plant=dataclasses.replace(data.plant, **odd))
    figure = plots.overview(data, r"$\frac$")
    figure.savefig(io.BytesIO(), dpi=20)
    assert r"a$x_\frac$" in figure.axes[0].get_ylabel().replace(r"\$", "$")


# -- figures ---------------------------------------------------------------------------------------------


def test_summary_of_a_known_run(config: Config, messages: list[Logged]) -> None:
    run = gather(config, messages)
    summary = summarise(run)
    x = np.array([s.x for s in run.plant_states])
    z, y = x[:, 0] - 0.5, x[:, 1] - 1.6875
    assert summary.ticks == STEPS
    assert summary.late_ticks == 2
    assert summary.weights_adopted == 2
    assert summary.weights_refused == 1
    assert summary.fallback_ticks == 1
    assert summary.soft_ticks == 1
    assert summary.iteration_limit_ticks == 1
    dx, u = x - PLANT.x_e, np.array([r.u for r in run.results])[:-1, 0] - PLANT.u_e
    assert summary.J == pytest.approx(0.05 * (np.sum(dx[:-1] ** 2) + np.sum(u**2)))
    assert summary.deviation == pytest.approx(0.05 * sum(z[:-1] ** 2 + y[:-1] ** 2))
    assert summary.overshoot == {"z": max(0.0, max(z / 0.35)), "y": max(0.0, max(y / 0.4))}
    assert summary.settled_s is None
    assert summary.settled_by_state_s == {"z": None, "y": None}
    assert summary.constraint_violations == sum(y < -0.5 - 0.5e-6)
    assert summary.constraint_violations > 5
    errors = [r.prediction_error for r in run.results]
    assert errors[0] is None
    assert summary.prediction_error.first_second == pytest.approx(np.mean(errors[1:21]))
    assert summary.prediction_error.last_second == pytest.approx(np.mean(errors[-20:]))
    assert summary.solve_ms is not None
    assert summary.solve_ms.max == max(t.solve_ms for t in run.timings)
    assert summary.log is None


def moved(messages: list[Logged], **changes: Any) -> list[Logged]:
    """Return the messages with fields of every plant state replaced by functions of the state."""
    return [
        (topic, msgspec.structs.replace(message, **{k: f(message) for k, f in changes.items()}), t)
        if topic is topics.PLANT_STATE
        else (topic, message, t)
        for topic, message, t in messages
    ]


@pytest.mark.parametrize("waits", ["hold", "safe"])
def test_summary_counts_after_the_hold_and_ignores_strangers(
    config: Config, messages: list[Logged], waits: InputSource
) -> None:
    plain = summarise(gather(config, messages))
    first = next(message for topic, message, _ in messages if topic is topics.PLANT_STATE)
    held = [
        (topics.PLANT_STATE, msgspec.structs.replace(first, seq=i, t=90.0 + i, source=waits), i)
        for i in range(5)
    ]
    later = moved(messages, seq=lambda s: s.seq + 5)
    liar = (
        topics.PLANT_STATE,
        msgspec.structs.replace(first, run_id="liar", x=[99.0] * 4, source="command"),
        6,
    )
    tick = next(message for topic, message, _ in messages if topic is topics.TICK)
    strange = (topics.TICK, msgspec.structs.replace(tick, run_id="stranger", state=liar[1]), 7)
    disturbed = summarise(gather(config, [*held, *later[:50], liar, strange, *later[50:]]))
    assert disturbed == plain


def test_a_plant_that_starts_again_is_another_episode(config: Config, messages: list[Logged]) -> None:
    """Half of the run, then a plant with another run id that is held for a while and then moves in the same way."""
    middle = STEPS // 2
    first = [one for one in messages if one[0] is not topics.PLANT_STATE or one[1].seq <= middle]
    states = [message for topic, message, _ in messages if topic is topics.PLANT_STATE]
    begin = states[0].t + 100.0
    held = [msgspec.structs.replace(states[0], run_id="plant-2", seq=i, t=begin + 0.05 * i) for i in range(4)]
    moving = [
        msgspec.structs.replace(s, run_id="plant-2", seq=s.seq + 3, t=begin + 0.05 * (s.seq + 3))
        for s in states[1 : middle + 1]
    ]
    tick = next(message for topic, message, _ in messages if topic is topics.TICK)
    answered = [
        (topics.TICK, msgspec.structs.replace(tick, seq=STEPS + s.seq, state=s), 2_000_000_000)
        for s in held[-1:]
    ]
    later = [(topics.PLANT_STATE, s, 2_000_000_000) for s in (*held, *moving)]
    run = gather(config, [*first, *later, *answered])
    summary = summarise(run)
    one, other = summary.episodes
    assert one.J > 0.0
    assert other == one
    assert (summary.J, summary.constraint_violations) == (one.J, 2 * one.constraint_violations)
    motion = trajectory(run, PLANT)
    assert motion.starts == (0, middle + 1)
    # The clock continues; the hold at the second start is no motion.
    assert motion.t[motion.starts[1]] == pytest.approx(100.0 + 3 * 0.05)
    assert motion.x[motion.starts[1]] == pytest.approx(PLANT.x0)
    line = plots.pictures(traces(run))["states"]().axes[0].lines[0]
    assert np.isnan(line.get_ydata()).sum() == 1


def test_pictures_show_the_target_of_the_plan_instead_of_the_equilibrium(
    config: Config, messages: list[Logged]
) -> None:
    data = traces(gather(config, messages))

    def lines(data: Traces, what: str) -> dict[str, np.ndarray]:
        (ax, *_) = plots.pictures(data)[what]().axes
        return {str(line.get_label()): np.array(line.get_ydata()) for line in ax.lines}

    assert "equilibrium" in lines(data, "states")
    n = len(data.t)
    led = np.arange(n) >= n // 2
    target_x, target_u = (
        np.where(led[:, None], rest + 0.01, np.nan) * np.ones((n, 1)) for rest in (PLANT.x_e, PLANT.u_e)
    )
    data = dataclasses.replace(data, target_x=target_x, target_u=target_u)
    for what, rest in (("states", PLANT.x_e[0]), ("input", PLANT.u_e[0])):
        shown = lines(data, what)
        assert "equilibrium" not in shown
        assert shown["target of the plan"] == pytest.approx(np.where(led, rest + 0.01, rest))


def test_summary_of_applied_input_and_settled_states(config: Config, messages: list[Logged]) -> None:
    at_rest = moved(messages, x=lambda s: PLANT.x_e.tolist(), applied=lambda s: [2.1547 + 5e-7])
    summary = summarise(gather(config, at_rest))
    assert (summary.settled_s, summary.constraint_violations, summary.deviation) == (0.0, 0, 0.0)
    # A state that begins at its target has no initial deviation, so its overshoot is undefined.
    assert summary.overshoot == {"z": None, "y": None}
    # With that input the state is not an equilibrium.
    assert summary.excess_between_samples is None
    outside = moved(at_rest, applied=lambda s: [2.1547 + 2e-6] if s.seq == 9 else None)
    assert summarise(gather(config, outside)).constraint_violations == 1
    late = moved(at_rest, x=lambda s: np.add(PLANT.x_e, [0, 0.021 * (s.seq == 17), 0, 0]).tolist())
    assert summarise(gather(config, late)).settled_by_state_s == {"z": 0.0, "y": 0.9}


def test_an_impossible_true_plant_is_named_without_a_traceback(
    config: Config, messages: list[Logged]
) -> None:
    run = gather(override(config, ["plant.truth.slop=1.4"]), messages)
    with pytest.raises(LogError, match=r"plant\.truth: .* no parameter 'slop'; did you mean 'slope'"):
        summarise(run)


def test_summary_counts_an_overrun_as_late(config: Config, messages: list[Logged]) -> None:
    slow = [
        (topic, msgspec.structs.replace(message, tick_ms=51.0) if message.seq == 12 else message, t)
        if topic is topics.TIMING
        else (topic, message, t)
        for topic, message, t in messages
    ]
    assert summarise(gather(config, slow)).late_ticks == 3


def test_the_first_and_last_predictions_of_a_slow_plant_count(config: Config, messages: list[Logged]) -> None:
    """At a period of 4 s, no single second contains a prediction."""
    spread = [
        (topic, msgspec.structs.replace(said, t=80.0 * said.t) if isinstance(said, Tick) else said, t)
        for topic, said, t in messages
    ]
    run = gather(override(config, ["rate=0.25"]), spread)
    first, last = run.results[1].prediction_error, run.results[-1].prediction_error
    assert first is not None
    assert summarise(run).prediction_error == PredictionError(first, last)


# -- pictures --------------------------------------------------------------------------------------------


def test_report_draws_from_the_log_alone(whole: Path, tmp_path: Path) -> None:
    files, failed = report(read_run(whole), tmp_path / "new" / "folder")
    assert failed == []
    parts = ["", "-states", "-input", "-error", "-model_error", "-timing", "-weights"]
    assert [file.name for file in files] == [f"run{part}.png" for part in parts]
    for file in files:
        assert file.read_bytes()[:4] == b"\x89PNG"


def test_a_picture_that_cannot_be_written_is_reported_and_the_others_are_drawn(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "overview", lambda *_of: Figure())
    monkeypatch.setattr(plots, "pictures", lambda _of: {"states": Figure})
    (tmp_path / "run.png").mkdir()
    drawn, (why,) = report(read_run(whole), tmp_path)
    assert [file.name for file in drawn] == ["run-states.png"]
    assert "run.png: cannot be written: it is a folder" in str(why)


def test_pictures_have_units_and_bounds(whole: Path) -> None:
    data = traces(read_run(whole))
    labels = [ax.get_ylabel() for ax in plots.pictures(data)["states"]().axes]
    assert labels == ["z (–)", "y (–)", "r (–)", "rdot (1/s)"]
    levels = {
        line.get_ydata()[0]
        for line in plots.pictures(data)["states"]().axes[1].lines
        if len(line.get_ydata())
    }
    assert {1.1875, 2.1875, 1.6875} <= levels
    assert data.t[0] == pytest.approx(0.0)
    assert np.diff(data.t) == pytest.approx(0.05)


def test_report_of_a_cut_log_and_of_one_without_a_network(
    whole: Path, config: Config, messages: list[Logged], tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:60_000])
    assert picture(read_run(cut), tmp_path / "cut.png").exists()
    plain = [
        (
            topic,
            msgspec.structs.replace(
                message, h=None, h_hat=None, prediction_error=None, weights_verdict="none"
            ),
            t,
        )
        if topic is topics.RESULT
        else (topic, message, t)
        for topic, message, t in messages
        if topic not in (topics.HIDDEN_WEIGHTS, topics.TIMING)
    ]
    drawn = plots.pictures(traces(gather(config, plain)))
    assert set(drawn) == {"states", "input", "error"}
    with pytest.raises(LogError, match="nothing to draw"):
        traces(gather(config, [entry for entry in plain if entry[0] is not topics.RESULT]))


def test_any_plant_has_its_names_on_the_axes(
    config: Config, messages: list[Logged], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = dataclasses.replace(
        PLANT,
        name="tank",
        states=("level", "flow", "a", "b"),
        inputs=("valve",),
        units={"level": "m", "flow": "m^3/s", "a": "1", "b": "1", "valve": "%", "t": "s"},
        kernel=("level", "valve"),
    )
    monkeypatch.setitem(plants.PLANTS, "tank", other)
    run = gather(override(config, ["plant.model=tank"]), messages)
    drawn = plots.pictures(traces(run))
    assert drawn["states"]().axes[0].get_ylabel() == "level (m)"
    assert drawn["input"]().axes[0].get_ylabel() == "valve (%)"
    monkeypatch.delitem(plants.PLANTS, "tank")
    with pytest.raises(LogError, match="no plant is called 'tank'"):
        summarise(run)


def test_reading_needs_neither_torch_nor_a_display() -> None:
    assert "torch" not in imported("import run_log.reporting.report, run_log.replaying.replay")


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("elsewhere"), Path.mkdir])
def test_a_picture_replaces_only_files(tmp_path: Path, make: Callable[[Path], None]) -> None:
    (tmp_path / "elsewhere").write_text("another file")
    make(tmp_path / "run.png")
    kind = (tmp_path / "run.png").lstat().st_mode
    with pytest.raises(LogError, match=r"run\.png: cannot be written: it is a (pipe|link|folder)"):
        save(Figure, tmp_path / "run.png")
    assert (tmp_path / "run.png").lstat().st_mode == kind
    assert (tmp_path / "elsewhere").read_text() == "another file"


def test_a_picture_of_an_unknown_kind_is_refused_with_those_that_are_known(
    whole: Path, tmp_path: Path
) -> None:
    with pytest.raises(LogError, match=r"not a picture format.*png.*svg"):
        picture(read_run(whole), tmp_path / "run.picture")
