"""Pictures over time: the paper's three figures, what a changed plant does, Lemma 1."""

from __future__ import annotations

import msgspec
import numpy as np
from matplotlib.axes import Axes

from lbmpc.plants import Plant
from run_log.reporting.plots import GREY, VERMILION
from tandem.experiments.reporting.style import Look, Picture, figure, legend_above, looks
from tandem.experiments.study.results import CaseResult


def trajectories(results: list[CaseResult], plant: Plant) -> list[Picture]:
    """The paper's figures: the performance states and the solver's time, each over time."""
    drawn = [_state(results, plant, i) for i in range(len(plant.performance))]
    timed = [result for result in results if result.timing is not None]
    return [*drawn, _solver(timed)] if timed else drawn


def _state(results: list[CaseResult], plant: Plant, i: int) -> Picture:
    made, (ax,) = figure(height=3.0)
    index = plant.performance[i]
    name, full = plant.states[index], _full_name(plant, index)
    for result, look in zip(results, looks(results), strict=True):
        _band(ax, result, look, i)
    ax.axhline(plant.x_e[index], color=GREY, linewidth=0.7, zorder=0)
    _bounds(ax, plant, index)
    ax.set_xlabel("time (s)")
    ax.set_ylabel(f"{full} ({_unit(plant, name)})")
    legend_above(ax)
    return Picture(
        made,
        f"{full[0].upper()}{full[1:]}. Line: median over the seeds; band: all of them. Thin line: equilibrium; shaded: "
        "outside the bounds.",
        f"{full} over time for {', '.join(result.label for result in results)}",
    )


def _band(ax: Axes, result: CaseResult, look: Look, i: int) -> None:
    """Median over the runs, and everything between the lowest and the highest."""
    runs = [np.array(r.traces.x)[:, i] for r in result.records if r.traces is not None and r.lost is None]
    if not runs:
        return
    t = np.arange(len(runs[0])) * result.case.config.period
    values = np.array(runs)
    label = result.label + (f" ({len(runs)} seeds)" if np.ptp(values, axis=0).max() > 0 else "")
    ax.plot(
        t,
        np.median(values, axis=0),
        color=look.colour,
        linestyle=look.line,
        linewidth=1.5,
        marker=look.marker,
        markevery=(len(t) // 20, max(1, len(t) // 8)),
        markersize=4,
        label=label,
    )
    ax.fill_between(t, values.min(axis=0), values.max(axis=0), color=look.colour, alpha=0.18, linewidth=0)


def _bounds(ax: Axes, plant: Plant, index: int) -> None:
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
        times = np.array(result.timing.runs)
        t = np.arange(times.shape[1]) * result.case.config.period
        ax.plot(
            t,
            np.median(times, axis=0),
            color=look.colour,
            linestyle=look.line,
            linewidth=1.2,
            marker=look.marker,
            markevery=(len(t) // 20, max(1, len(t) // 8)),
            markersize=4,
            label=result.label,
        )
        ax.fill_between(t, times.min(axis=0), times.max(axis=0), color=look.colour, alpha=0.15, linewidth=0)
    period = results[0].case.config.period * 1e3
    ax.set_yscale("log")
    ax.axhline(period, color=VERMILION, linewidth=1.0, linestyle=(0, (6, 2)))
    ax.text(0.0, period * 0.93, f"sampling period, {period:g} ms", va="top", fontsize=8.5, color=VERMILION)
    ax.yaxis.set_major_formatter(lambda value, _position: f"{value:g}")
    ax.set_xlabel("time (s)")
    ax.set_ylabel("one solve (ms)")
    legend_above(ax)
    runs = max(len(result.timing.runs) for result in results if result.timing is not None)
    return Picture(
        made,
        f"Solver time, measured alone, one process at a time, {runs} runs each. Line: median; band: all of them.",
        "time of one solve over time, logarithmic",
    )


def recovery(results: list[CaseResult], plant: Plant) -> list[Picture]:
    """The first performance state before and after the plant changes, one picture for each change."""
    by_fault: dict[bytes, list[CaseResult]] = {}
    for result in results:
        by_fault.setdefault(msgspec.json.encode(result.case.faults), []).append(result)
    index = plant.performance[0]
    drawn = []
    for same in by_fault.values():
        made, (above, below) = figure(rows=2, height=1.9)
        for result, look in zip(same, looks(same), strict=True):
            _band(above, result, look, 0)
            _errors(below, result, look)
        drift = same[0].case.faults.drift
        said = "no change"
        if drift is not None:
            values = ", ".join(f"{n} = {plant.parameters[n]:g} to {v:g}" for n, v in drift.to.items())
            said = values + (
                f" over {drift.over:g} s from {drift.at:g} s on" if drift.over else f" at {drift.at:g} s"
            )
            for ax in (above, below):
                ax.axvspan(drift.at, drift.at + max(drift.over, 0.02), color=GREY, alpha=0.3, linewidth=0)
        above.axhline(plant.x_e[index], color=GREY, linewidth=0.7, zorder=0)
        above.set_ylabel(f"{_full_name(plant, index)} ({_unit(plant, plant.states[index])})")
        below.set_yscale("log")
        below.set_ylabel("|ĥ − h|")
        below.set_xlabel("time (s)")
        legend_above(above)
        drawn.append(
            Picture(
                made, f"{said[0].upper()}{said[1:]}: grey. Above the state, below the prediction error.", said
            )
        )
    return drawn


def _errors(ax: Axes, result: CaseResult, look: Look) -> None:
    runs = [r.traces.error for r in result.records if r.traces is not None and r.lost is None]
    if runs and result.oracle != "linear":
        values = np.median(np.array(runs, dtype=float), axis=0)
        t = np.arange(len(values)) * result.case.config.period
        ax.plot(
            t, np.where(values > 0, values, np.nan), color=look.colour, linestyle=look.line, linewidth=1.1
        )


def lemma(results: list[CaseResult], plant: Plant) -> list[Picture]:
    """Accumulated squared error of the first run of each case, beside its bounds."""
    shown = [(r, r.records[0].lemma) for r in results if r.records[0].lemma is not None]
    made, axes = figure(rows=len(shown), height=2.4)
    lines = []
    for ax, (result, found) in zip(axes, shown, strict=True):
        assert found is not None
        t = np.arange(1, len(found.error) + 1) * result.case.config.period
        ax.semilogy(t, found.accumulated, color=LOOK_ERROR.colour, linewidth=1.6, label="accumulated |x̃|²")
        ax.semilogy(
            t, found.bound, color=VERMILION, linestyle=(0, (5, 1.5)), label="bound (ii), this run's constants"
        )
        ax.semilogy(
            t,
            found.bound_beforehand,
            color=GREY,
            linestyle=(0, (1, 1.2)),
            label="bound (iii), constants known before",
        )
        ax.set_ylabel("sum (units of x²)")
        ax.set_title(result.label, loc="right", fontsize=8.5, pad=2)
        ratio = float((found.accumulated / found.bound).max())
        lines.append(
            f"{result.label}: γ = {found.gamma:g}, largest |φ|² = {found.sigma2:.3g} "
            f"(allowed: {found.sigma2_bound:g}), V_a(K_0) = {found.V0:.3g}, largest |ε_j|² = {max(found.epsilon):.3g}, "
            f"W̄ = {found.W_bar:.3g}; the sum reaches at most {ratio:.2g} of its bound (ii)."
        )
    axes[-1].set_xlabel("time (s)")
    axes[0].legend(loc="lower left", bbox_to_anchor=(0, 1.08), frameon=False, fontsize=8.5, borderaxespad=0.0)
    return [
        Picture(made, " ".join(lines), "accumulated squared prediction error beside its bounds, logarithmic")
    ]


LOOK_ERROR = Look("#0072B2", "-", "o")


def _full_name(plant: Plant, index: int) -> str:
    return plant.names.get(plant.states[index], plant.states[index])


def _unit(plant: Plant, name: str) -> str:
    unit = plant.units.get(name, "")
    return "dimensionless" if unit in ("", "1") else unit
