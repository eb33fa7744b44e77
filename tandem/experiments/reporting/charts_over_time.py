"""Charts over time: the three figures of the paper, the recovery of a changed plant, and Lemma 1."""

from __future__ import annotations

import msgspec
import numpy as np

from lbmpc.plants import Description, Plant
from run_log.reporting.plots import BLUE, GREY, VERMILION
from tandem.experiments.reporting.charts import Chart, Level, Line, Picture, lines_of
from tandem.experiments.reporting.style import full_name, named
from tandem.experiments.study.results import CaseResult
from tandem.experiments.study.work import Traces

TIME = "time (s)"
BAND = "Line: the run, or the median if a case has several runs. Band: all runs of the case."


def trajectories(results: list[CaseResult], plant: Description) -> list[Picture]:
    """The figures of the paper: each performance state and the solve time, over time."""
    made = [_state_picture(results, plant, i) for i in range(len(plant.performance))]
    timed = [result for result in results if result.timing is not None]
    return [*made, _solve_time(timed)] if timed else made


def _state_picture(results: list[CaseResult], plant: Description, i: int) -> Picture:
    full = full_name(plant, plant.performance[i])
    caption = f"{full[0].upper()}{full[1:]}. {BAND} Shaded: outside the bounds.{_lost(results)}"
    return Picture(_state(results, plant, i), caption, f"{full} over time")


def _state(results: list[CaseResult], plant: Description, i: int) -> Chart:
    index = plant.performance[i]
    full = full_name(plant, index)
    return Chart(
        title=f"{full[0].upper()}{full[1:]}",
        x_label=TIME,
        y_label=named(plant, index),
        lines=lines_of(results, lambda result: [np.array(one.x)[:, i] for one in _whole(result)]),
        levels=(Level(float(plant.x_e[index]), "equilibrium"),),
        bounds=(float(plant.x_min[index]), float(plant.x_max[index])),
    )


def _whole(result: CaseResult) -> list[Traces]:
    """Return the traces of the runs in which the plant was not lost."""
    return [r.traces for r in result.records if r.traces is not None and r.lost is None]


def _lost(results: list[CaseResult]) -> str:
    lost = sum(record.lost is not None for result in results for record in result.records)
    return f" Not drawn: {lost} of the runs, in which the plant was lost." if lost else ""


def _solve_time(results: list[CaseResult]) -> Picture:
    period = results[0].case.config.period * 1e3
    chart = Chart(
        title="Solve time",
        x_label=TIME,
        y_label="one solve (ms)",
        lines=lines_of(results, _timed),
        scale="log",
        levels=(Level(period, f"period, {period:g} ms"),),
    )
    runs = max(len(result.timing.runs) for result in results if result.timing is not None)
    many = "one run" if runs == 1 else f"up to {runs} runs"
    caption = (
        f"Solve time of each tick, measured alone, one process at a time, in {many} of each case. {BAND}"
    )
    return Picture(chart, caption, "solve time over time, logarithmic")


def _timed(result: CaseResult) -> list[np.ndarray]:
    return [] if result.timing is None else [np.array(run) for run in result.timing.runs]


def recovery(results: list[CaseResult], plant: Description) -> list[Picture]:
    """The first performance state and the prediction error before and after the plant changes, for each change."""
    by_fault: dict[bytes, list[CaseResult]] = {}
    for result in results:
        by_fault.setdefault(msgspec.json.encode(result.case.faults), []).append(result)
    made = []
    for same in by_fault.values():
        span, change = _change(same[0], plant)
        state = _state(same, plant, 0)._replace(span=span)
        learning = [result for result in same if result.oracle != "linear"]
        errors = Chart(
            title="Prediction error",
            x_label=TIME,
            y_label="|ĥ − h| (units of x)",
            lines=lines_of(learning, _errors),
            scale="log",
            span=span,
        )
        note = f"{change[0].upper()}{change[1:]}, marked in grey. {BAND}{_lost(same)}"
        made += [
            Picture(state, f"{state.title}. {note}", f"{state.title} over time; {change}"),
            Picture(errors, f"Prediction error. {note}", f"prediction error over time; {change}"),
        ]
    return made


def _change(result: CaseResult, plant: Description) -> tuple[tuple[float, float] | None, str]:
    """Return the times of the plant's changes, in seconds, and their descriptions."""
    drift = result.case.faults.drift
    if drift is None:
        return None, "no change of the plant"
    own = plant.parameters if isinstance(plant, Plant) else {}
    truth = result.case.config.plant.truth
    before = {**own, **(truth if isinstance(truth, dict) else {})}
    values = ", ".join(
        f"{name} = {before[name]:g} to {value:g}" if name in before else f"{name} to {value:g}"
        for name, value in drift.to.items()
    )
    when = f"over {drift.over:g} s from {drift.at:g} s on" if drift.over else f"at {drift.at:g} s"
    return (drift.at, drift.at + max(drift.over, 0.02)), f"{values} {when}"


def _errors(result: CaseResult) -> list[np.ndarray]:
    runs = [np.array(traces.error, dtype=float) for traces in _whole(result)]
    return [np.where(run > 0, run, np.nan) for run in runs]


def lemma(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Accumulated squared prediction error of the first run of each case, beside its bounds."""
    made = []
    for result in results:
        found = result.records[0].lemma
        if found is None:
            continue
        t = np.arange(1, len(found.error) + 1) * result.case.config.period
        lines = [
            Line("accumulated |x̃|²", {"color": BLUE, "linestyle": "-"}, t, found.accumulated),
            Line(
                "bound (ii), constants of this run",
                {"color": VERMILION, "linestyle": (0, (5, 1.5))},
                t,
                found.bound,
            ),
            Line(
                "bound (iii), constants known before the run",
                {"color": GREY, "linestyle": (0, (1, 1.2))},
                t,
                found.bound_beforehand,
            ),
        ]
        ratio = float((found.accumulated / found.bound).max())
        caption = (
            f"{result.label}, seed {result.rows[0].seed}: γ = {found.gamma:g}, largest |φ|² = {found.sigma2:.3g} "
            f"(allowed: {found.sigma2_bound:g}), V_a(K_0) = {found.V0:.3g}, largest |ε_j|² = {max(found.epsilon):.3g}, "
            f"W̄ = {found.W_bar:.3g}. The largest ratio of the sum to bound (ii) is {ratio:.2g}."
        )
        chart = Chart(f"Lemma 1: {result.label}", TIME, "sum (units of x²)", lines, scale="log")
        made.append(
            Picture(chart, caption, "accumulated squared prediction error beside its bounds, logarithmic")
        )
    return made
