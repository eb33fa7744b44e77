"""Pictures over time: the paper's three figures, what a changed plant does, Lemma 1."""

from __future__ import annotations

import msgspec
import numpy as np
from matplotlib.axes import Axes

from lbmpc.plants import Description, Plant
from run_log.reporting.plots import BLUE, GREY, VERMILION
from tandem.experiments.reporting.style import Look, Picture, figure, full_name, legend_above, looks, named
from tandem.experiments.study.results import CaseResult
from tandem.experiments.study.work import Traces


def trajectories(results: list[CaseResult], plant: Description) -> list[Picture]:
    """The paper's figures: the performance states and the solver's time, each over time."""
    drawn = [_state(results, plant, i) for i in range(len(plant.performance))]
    timed = [result for result in results if result.timing is not None]
    return [*drawn, _solver(timed)] if timed else drawn


def _state(results: list[CaseResult], plant: Description, i: int) -> Picture:
    made, (ax,) = figure(height=3.0)
    index = plant.performance[i]
    full = full_name(plant, index)
    for result, look in zip(results, looks(results), strict=True):
        _state_band(ax, result, look, i)
    ax.axhline(plant.x_e[index], color=GREY, linewidth=0.7, zorder=0)
    _bounds(ax, plant, index)
    ax.set_xlabel("time (s)")
    ax.set_ylabel(named(plant, index))
    legend_above(ax)
    return Picture(
        made,
        f"{full[0].upper()}{full[1:]}. Line: median over the seeds; band: all of them. Thin line: equilibrium; shaded: "
        "outside the bounds.",
        f"{full} over time for {', '.join(result.label for result in results)}",
    )


def _whole(result: CaseResult) -> list[Traces]:
    """Of the runs whose plant was not lost."""
    return [r.traces for r in result.records if r.traces is not None and r.lost is None]


def _state_band(ax: Axes, result: CaseResult, look: Look, i: int) -> None:
    values = np.array([np.array(traces.x)[:, i] for traces in _whole(result)])
    if len(values):
        seeds = f" ({len(values)} seeds)" if np.ptp(values, axis=0).max() > 0 else ""
        _band(ax, values, result, look, result.label + seeds, linewidth=1.5, alpha=0.18)


def _band(
    ax: Axes, values: np.ndarray, result: CaseResult, look: Look, label: str, linewidth: float, alpha: float
) -> None:
    """Median over the runs, and everything between the lowest and the highest. values: (runs, samples)."""
    t = np.arange(values.shape[1]) * result.case.config.period
    every = len(t) // 20, max(1, len(t) // 8)
    middle = np.median(values, axis=0)
    ax.plot(t, middle, **look, linewidth=linewidth, markevery=every, markersize=4, label=label)
    low, high = values.min(axis=0), values.max(axis=0)
    ax.fill_between(t, low, high, color=look["color"], alpha=alpha, linewidth=0)


def _bounds(ax: Axes, plant: Description, index: int) -> None:
    low, high = ax.get_ylim()
    reach = 0.6 * (high - low)
    shown = [b for b in (plant.x_min[index], plant.x_max[index]) if low - reach < b < high + reach]
    low, high = min([low, *shown]), max([high, *shown])
    margin = 0.05 * (high - low)
    ax.set_ylim(low - margin, high + margin)
    for bound in shown:
        ax.axhline(bound, color=VERMILION, linewidth=1.0, linestyle=(0, (6, 2)))
        beyond = low - margin if bound == plant.x_min[index] else high + margin
        ax.axhspan(bound, beyond, color=VERMILION, alpha=0.10, linewidth=0, hatch="///")


def _solver(results: list[CaseResult]) -> Picture:
    made, (ax,) = figure(height=3.0)
    for result, look in zip(results, looks(results), strict=True):
        assert result.timing is not None
        _band(ax, np.array(result.timing.runs), result, look, result.label, linewidth=1.2, alpha=0.15)
    period = results[0].case.config.period * 1e3
    ax.set_yscale("log")
    ax.axhline(period, color=VERMILION, linewidth=1.0, linestyle=(0, (6, 2)))
    ax.text(0.0, period * 0.93, f"sampling period, {period:g} ms", va="top", fontsize=8.5, color=VERMILION)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xlabel("time (s)")
    ax.set_ylabel("one solve (ms)")
    legend_above(ax)
    runs = max(len(result.timing.runs) for result in results if result.timing is not None)
    return Picture(
        made,
        f"Solver time, measured alone, one process at a time, {runs} runs each. Line: median; band: all of them.",
        "time of one solve over time, logarithmic",
    )


def recovery(results: list[CaseResult], plant: Description) -> list[Picture]:
    """The first performance state before and after the plant changes, one picture for each change."""
    by_fault: dict[bytes, list[CaseResult]] = {}
    for result in results:
        by_fault.setdefault(msgspec.json.encode(result.case.faults), []).append(result)
    index = plant.performance[0]
    drawn = []
    for same in by_fault.values():
        made, (above, below) = figure(rows=2, height=1.9)
        for result, look in zip(same, looks(same), strict=True):
            _state_band(above, result, look, 0)
            _errors(below, result, look)
        drift = same[0].case.faults.drift
        said = "no change"
        if drift is not None:
            own = plant.parameters if isinstance(plant, Plant) else {}
            truth = same[0].case.config.plant.truth
            before = {**own, **(truth if isinstance(truth, dict) else {})}
            values = ", ".join(
                f"{n} = {before[n]:g} to {v:g}" if n in before else f"{n} to {v:g}"
                for n, v in drift.to.items()
            )
            when = f"over {drift.over:g} s from {drift.at:g} s on" if drift.over else f"at {drift.at:g} s"
            said = f"{values} {when}"
            for ax in (above, below):
                ax.axvspan(drift.at, drift.at + max(drift.over, 0.02), color=GREY, alpha=0.3, linewidth=0)
        above.axhline(plant.x_e[index], color=GREY, linewidth=0.7, zorder=0)
        above.set_ylabel(named(plant, index))
        below.set_yscale("log")
        below.set_ylabel("|ĥ − h|")
        below.set_xlabel("time (s)")
        legend_above(above)
        caption = f"{said[0].upper()}{said[1:]}: grey. Above the state, below the prediction error."
        drawn.append(Picture(made, caption, said))
    return drawn


def _errors(ax: Axes, result: CaseResult, look: Look) -> None:
    runs = [traces.error for traces in _whole(result)]
    if runs and result.oracle != "linear":
        values = np.median(np.array(runs, dtype=float), axis=0)
        t = np.arange(len(values)) * result.case.config.period
        ax.plot(t, np.where(values > 0, values, np.nan), **{**look, "marker": ""}, linewidth=1.1)


def lemma(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Accumulated squared error of the first run of each case, beside its bounds."""
    shown = [(r, r.records[0].lemma) for r in results if r.records[0].lemma is not None]
    made, axes = figure(rows=len(shown), height=2.4)
    lines = []
    for ax, (result, found) in zip(axes, shown, strict=True):
        assert found is not None
        t = np.arange(1, len(found.error) + 1) * result.case.config.period
        ax.semilogy(t, found.accumulated, color=BLUE, linewidth=1.6, label="accumulated |x̃|²")
        for bound, colour, line, label in (
            (found.bound, VERMILION, (5, 1.5), "bound (ii), this run's constants"),
            (found.bound_beforehand, GREY, (1, 1.2), "bound (iii), constants known before"),
        ):
            ax.semilogy(t, bound, color=colour, linestyle=(0, line), label=label)
        ax.set_ylabel("sum (units of x²)")
        ax.set_title(result.label, loc="right", fontsize=8.5, pad=2)
        ratio = float((found.accumulated / found.bound).max())
        lines.append(
            f"{result.label}: γ = {found.gamma:g}, largest |φ|² = {found.sigma2:.3g} "
            f"(allowed: {found.sigma2_bound:g}), V_a(K_0) = {found.V0:.3g}, largest |ε_j|² = {max(found.epsilon):.3g}, "
            f"W̄ = {found.W_bar:.3g}; the sum reaches at most {ratio:.2g} of its bound (ii)."
        )
    axes[-1].set_xlabel("time (s)")
    legend_above(axes[0], height=1.08, columns=1, space=0.0)
    alt = "accumulated squared prediction error beside its bounds, logarithmic"
    return [Picture(made, " ".join(lines), alt)]
