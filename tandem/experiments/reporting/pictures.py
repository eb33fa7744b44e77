"""Pictures of a group: their selection, and the static ones, which show distributions over runs."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from lbmpc.plants import Description
from run_log.reporting.canvas import words
from run_log.reporting.plots import BLUE, GREY, VERMILION
from tandem.experiments.reporting.charts import Picture
from tandem.experiments.reporting.charts_by_episode import episodes
from tandem.experiments.reporting.charts_over_time import lemma, recovery, trajectories
from tandem.experiments.reporting.families import by_family, family_label, places, what_varies
from tandem.experiments.reporting.style import figure, legend_above, looks, named
from tandem.experiments.study.declaration import Picture as Kind
from tandem.experiments.study.results import CaseResult

WIDE = 50.0
"""Percent of regret. Beyond it the axis is logarithmic, except for the first percent on either side of 0."""
MOST = 40
"""Largest number of cases in one picture."""
STROKES = 100
"""Largest number of runs of a case that are drawn singly; for more, quantiles are drawn."""


def draw(kind: Kind, results: list[CaseResult], plant: Description, reference: str | None) -> list[Picture]:
    """Return the pictures of one group."""
    match kind:
        case "episodes":
            return episodes(results)
        case "trajectories":
            return trajectories(results, plant)
        case "states":
            return states(results, plant)
        case "survival":
            return survival(results, plant)
        case "recovery":
            return recovery(results, plant)
        case "lemma":
            return lemma(results, plant)
        case "rows":
            return rows(results, reference)


def rows(results: list[CaseResult], reference: str | None) -> list[Picture]:
    """Regret of each case: median, and from the best to the worst run. J where no case has a regret."""
    name = "regret" if any(row.regret is not None for result in results for row in result.rows) else "J"
    scale = 100 if name == "regret" else 1
    shown, left_out = _fewer(results, name, reference)
    every = [scale * result.values(name) for result in shown]
    finite = np.concatenate(every)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return []
    made, (ax,) = figure(height=0.45 + 0.3 * len(shown))
    low, high = min(0.0, float(finite.min())), float(finite.max())
    right = high + 0.4 * max(high - low, 1e-9)
    for i, (result, values) in enumerate(zip(shown, every, strict=True)):
        _strip(ax, i, result, values[~np.isnan(values)], right, result.case.name == reference)
    _regret_scale(ax, finite, name)
    ax.set_yticks(range(len(shown)), [words(_wrapped(result.label)) for result in shown])
    ax.set_ylim(len(shown) - 0.5, -0.5)
    ax.set_xlabel("J above that of the true h (%)" if name == "regret" else "J: sum of the stage costs")
    caption = f"{name[0].upper()}{name[1:]} of every run (strokes) and the median (dot)."
    if any(result.case.name == reference for result in shown):
        caption += " Diamond and dashed line: the reference case of the comparison."
    if any(not record.kept for result in shown for record in result.records):
        caption += " At the right: runs that leave the bounds."
    if left_out:
        caption += (
            f" The picture shows {MOST} cases: the lowest and the highest medians. The table has all cases."
        )
    return [Picture(made, caption, f"{name} by case")]


def _fewer(results: list[CaseResult], name: str, reference: str | None) -> tuple[list[CaseResult], int]:
    """At most MOST cases, in the order of the file: those with the lowest and the highest medians."""
    if len(results) <= MOST:
        return results, 0
    base = [i for i, result in enumerate(results) if result.case.name == reference]
    order = sorted(range(len(results)), key=lambda i: np.nan_to_num(results[i].median(name), nan=np.inf))
    order = [i for i in order if i not in base]
    half = (MOST - len(base)) // 2
    chosen = sorted([*base, *order[:half], *order[-half:]])
    return [results[i] for i in chosen], len(results) - len(chosen)


def _strip(ax: Axes, i: int, result: CaseResult, values: np.ndarray, right: float, own: bool) -> None:
    """The runs of one case at height i. Lost runs are at `right`."""
    if not values.size:
        return
    shown = np.minimum(values, right)
    middle = min(float(np.median(values)), right)
    colour = BLUE if own else "black"
    ax.plot(
        [shown.min(), shown.max()], [i, i], color=colour, linewidth=3.5, alpha=0.25, solid_capstyle="butt"
    )
    strokes = shown if len(shown) <= STROKES else np.quantile(shown, np.linspace(0, 1, STROKES))
    ax.plot(strokes, np.full(len(strokes), i), "|", color=colour, markersize=6, alpha=0.7)
    ax.plot(middle, i, "D" if own else "o", color=colour, markersize=5)
    broken = sum(not record.kept for record in result.records)
    if broken:
        place: Any = {
            "xycoords": ("axes fraction", "data"),
            "va": "center",
            "fontsize": 8.5,
            "color": VERMILION,
        }
        ax.annotate(f" {broken} of {len(result.records)}", (1.0, i), **place)
    if own:
        ax.axvline(middle, color=BLUE, linewidth=0.9, linestyle=(0, (4, 2)), zorder=0)


def _regret_scale(ax: Axes, finite: np.ndarray, name: str) -> None:
    """Make the axis logarithmic if the values differ widely."""
    if finite.min() > 0 and finite.max() > 6 * finite.min():
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        if finite.max() < 60 * finite.min():
            ax.xaxis.set_minor_formatter(lambda at, _position: f"{at:g}" if f"{at:e}"[0] in "25" else "")
        else:
            ax.xaxis.set_minor_locator(NullLocator())
    elif name == "regret":
        # Below 0 is better than the true h.
        ax.axvline(0.0, color=GREY, linewidth=0.9, zorder=0)
        if finite.max() > WIDE:
            ax.set_xscale("symlog", linthresh=1.0)
            ax.xaxis.set_major_formatter("{x:g}")


def _wrapped(label: str) -> str:
    if len(label) <= 22:
        return label
    cut = label.rfind(" ", 0, 23)
    return label if cut < 0 else label[:cut] + "\n" + label[cut + 1 :]


def states(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Draw each initial state: constraints kept in every run, in some runs, or in none."""
    first, *more = [*plant.performance, *(i for i in range(plant.d) if i not in plant.performance)]
    second = more[0] if more else None
    columns = 2
    shown = results[:MOST]
    made, axes = figure(rows=-(-len(shown) // columns), columns=columns, height=2.0)
    for ax in axes[len(shown) :]:
        ax.set_visible(False)
    for ax, result in zip(axes, shown, strict=False):
        kept_from: dict[tuple[float, float], list[bool]] = {}
        for row, record in zip(result.rows, result.records, strict=True):
            kept_from.setdefault((row.x0[first], 0.0 if second is None else row.x0[second]), []).append(
                record.kept
            )
        for (across, up), kept in kept_from.items():
            if all(kept):
                ax.plot(across, up, "o", color=BLUE, markersize=7)
            elif not any(kept):
                ax.plot(across, up, "x", color=VERMILION, markersize=7, markeredgewidth=2)
            else:
                ax.plot(across, up, "o", markerfacecolor="white", markeredgecolor=VERMILION, markersize=11)
                ax.text(across, up, f"{sum(kept)}", ha="center", va="center", fontsize=7.5)
        rest = 0.0 if second is None else plant.x_e[second]
        ax.plot(plant.x_e[first], rest, "+", color=GREY, markersize=14, zorder=0)
        ax.set_xlim(*_frame(plant, first))
        if second is None:
            ax.set_yticks([])
        else:
            ax.set_ylim(*_frame(plant, second))
        every = len(result.records)
        ax.set_title(words(f"{result.label}: {sum(r.kept for r in result.records)} of {every}"), fontsize=9)
    for ax in axes[-columns:]:
        ax.set_xlabel(words(_axis(plant, first)))
    for ax in axes[::columns]:
        ax.set_ylabel("" if second is None else words(_axis(plant, second)))
    caption = (
        f"Initial states. {named(plant, first)}"
        + ("" if second is None else f" across, {named(plant, second)} up")
        + ". Dot: every run from there keeps all true constraints at samples. Cross: no run does. "
        "Number: this many runs do. The axes end at the bounds. The plus marks the equilibrium."
    )
    if len(results) > MOST:
        caption += f" The picture shows the first {MOST} cases."
    return [Picture(made, caption, "initial states that are kept, by controller")]


def _axis(plant: Description, i: int) -> str:
    """The short name of a state with its unit: small axes have no room for the full name."""
    unit = plant.units.get(plant.states[i], "")
    return f"{plant.states[i]} ({'–' if unit in ('', '1') else unit})"


def _frame(plant: Description, i: int) -> tuple[float | None, float | None]:
    """Return the bounds of a state; None if it has none."""
    low, high = (float(bound[i]) if np.isfinite(bound[i]) else None for bound in (plant.x_min, plant.x_max))
    return low, high


def survival(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Share of the runs that keep all true constraints, against the value that the cases vary."""
    made, (ax,) = figure(height=3.3)
    families = by_family(results)
    heads = [members[0] for members in families.values()]
    at_first = places(next(iter(families.values())))
    for i, (members, look) in enumerate(zip(families.values(), looks(heads), strict=True)):
        # Side by side, because many points coincide.
        at = np.arange(len(members)) + 0.07 * (i - (len(heads) - 1) / 2)
        runs = len(members[0].rows)
        label = words(f"{family_label(members[0])} ({runs} {'run' if runs == 1 else 'runs'} each)")
        ax.plot(at, [100 * one.kept for one in members], **look, markersize=5, linewidth=1.4, label=label)
    # Equal steps, because most values are small.
    ax.set_xticks(range(len(at_first)), [words(place) for place in at_first])
    ax.set_ylim(-4, 104)
    ax.set_ylabel("runs that keep all constraints (%)")
    ax.set_xlabel(words(f"{what_varies(next(iter(families.values())), plant)} (steps are not even)"))
    legend_above(ax, columns=1)
    caption = (
        "Share of the runs that keep all true constraints at samples. Equal lines are drawn side by side."
    )
    return [Picture(made, caption, "share of runs kept, by value and oracle")]
