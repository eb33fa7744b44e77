"""Pictures of many runs: regret of each case, initial states, survival. And which picture a group has."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import NullLocator

from lbmpc.plants import Description
from run_log.reporting.plots import BLUE, GREY, VERMILION
from tandem.experiments.reporting.pictures_by_episode import episodes
from tandem.experiments.reporting.pictures_over_time import lemma, recovery, trajectories
from tandem.experiments.reporting.style import Picture, figure, legend_above, looks, named
from tandem.experiments.study.declaration import Picture as Kind
from tandem.experiments.study.results import CaseResult

WIDE = 50.0
"""Percent of regret from which on the axis is logarithmic, but for its first percent on either side of 0."""


def draw(kind: Kind, results: list[CaseResult], plant: Description, reference: str | None) -> list[Picture]:
    """The pictures of one group."""
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
    regret = any(row.regret is not None for result in results for row in result.rows)
    made, (ax,) = figure(height=0.45 + 0.27 * len(results))
    every = [100 * result.values("regret") if regret else result.values("J") for result in results]
    finite = np.concatenate(every)
    finite = finite[np.isfinite(finite)]
    if not finite.size:
        return []
    low, high = min(0.0, float(finite.min())), float(finite.max())
    right = high + 0.4 * max(high - low, 1e-9)
    for i, (result, all_values) in enumerate(zip(results, every, strict=True)):
        values, own = all_values[~np.isnan(all_values)], result.case.name == reference
        if not values.size:
            continue
        shown = np.minimum(values, right)
        middle = min(float(np.median(values)), right)
        colour = BLUE if own else "black"
        reach = [shown.min(), shown.max()]
        ax.plot(reach, [i, i], color=colour, linewidth=3.5, alpha=0.25, solid_capstyle="butt")
        ax.plot(shown, np.full(len(shown), i), "|", color=colour, markersize=6, alpha=0.7)
        ax.plot(middle, i, "D" if own else "o", color=colour, markersize=5)
        lost = int((~np.isfinite(values)).sum())
        broken = sum(not record.kept for record in result.records)
        if lost or broken:
            said, beside = f"{broken} of {len(result.records)} leave the bounds", (shown.max(), i)
            place: Any = {"xytext": (5, 0), "textcoords": "offset points", "va": "center"}
            ax.annotate(said, beside, **place, fontsize=8, color=VERMILION)
        if own:
            ax.axvline(middle, color=BLUE, linewidth=0.9, linestyle=(0, (4, 2)), zorder=0)
    if finite.min() > 0 and finite.max() > 6 * finite.min():
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        if finite.max() < 60 * finite.min():
            ax.xaxis.set_minor_formatter(lambda at, _position: f"{at:g}" if f"{at:e}"[0] in "25" else "")
        else:
            ax.xaxis.set_minor_locator(NullLocator())
    elif regret:
        # What is left of it is better than the true h.
        ax.axvline(0.0, color=GREY, linewidth=0.9, zorder=0)
        if high > WIDE:
            ax.set_xscale("symlog", linthresh=1.0)
            ax.xaxis.set_major_formatter("{x:g}")
    ax.set_yticks(range(len(results)), [_wrapped(result.label) for result in results])
    ax.set_ylim(len(results) - 0.5, -0.5)
    what = "regret" if regret else "J"
    ax.set_xlabel("regret: J above that of the true h (%)" if regret else "J: sum of the stage costs")
    marked = "; diamond and dashed line: what the others are compared with" if reference else ""
    caption = f"{what[0].upper()}{what[1:]} of every run (strokes) and its median (dot){marked}."
    return [Picture(made, caption, f"{what} by case")]


def _wrapped(label: str) -> str:
    if len(label) <= 26:
        return label
    cut = label.rfind(" ", 0, 27)
    return label if cut < 0 else label[:cut] + "\n" + label[cut + 1 :]


def states(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Each initial state where it lies: kept, kept for some seeds, or not."""
    first, *more = [*plant.performance, *(i for i in range(plant.d) if i not in plant.performance)]
    second = more[0] if more else None
    columns = 2
    made, axes = figure(rows=-(-len(results) // columns), columns=columns, height=2.3)
    for ax in axes[len(results) :]:
        ax.set_visible(False)
    for ax, result in zip(axes, results, strict=False):
        kept_from: dict[tuple[float, float], list[bool]] = {}
        for row, record in zip(result.rows, result.records, strict=True):
            kept_from.setdefault((row.x0[first], 0.0 if second is None else row.x0[second]), []).append(
                record.kept
            )
        for (across, up), kept in kept_from.items():
            if all(kept):
                ax.plot(across, up, "o", color=BLUE, markersize=8)
            elif not any(kept):
                ax.plot(across, up, "x", color=VERMILION, markersize=8, markeredgewidth=2)
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
        ax.set_title(f"{result.label}: {result.kept:.0%} keep all", fontsize=9)
    for ax in axes[-columns:]:
        ax.set_xlabel(named(plant, first))
    for ax in axes[::columns]:
        ax.set_ylabel("" if second is None else named(plant, second))
    caption = (
        "Dot: every run from there keeps all true constraints at samples; cross: none does; number: so many seeds do. "
        "The frame is the bounds, the plus in the middle the equilibrium."
    )
    return [Picture(made, caption, "initial states that are kept, by controller")]


def _frame(plant: Description, i: int) -> tuple[float | None, float | None]:
    """A state's bounds; None where the axis is free, because there is none."""
    low, high = (float(bound[i]) if np.isfinite(bound[i]) else None for bound in (plant.x_min, plant.x_max))
    return low, high


def survival(results: list[CaseResult], plant: Description) -> list[Picture]:
    """Share of the runs that keep all true constraints, against what the cases vary."""
    made, (ax,) = figure(height=3.3)
    families = by_family(results)
    heads = [members[0] for members in families.values()]
    places: list[float] = []
    for i, (members, look) in enumerate(zip(families.values(), looks(heads), strict=True)):
        places = margins(members)
        # Side by side, since many lie on each other.
        at = np.arange(len(places)) + 0.07 * (i - (len(heads) - 1) / 2)
        runs = len(members[0].rows)
        label = f"{family_label(members[0])} ({runs} {'run' if runs == 1 else 'runs'})"
        ax.plot(at, [100 * one.kept for one in members], **look, markersize=5, linewidth=1.4, label=label)
    # Even steps: the margins crowd at the small end.
    ax.set_xticks(range(len(places)), [f"{place:g}" for place in places])
    ax.set_ylim(-4, 104)
    ax.set_ylabel("runs that keep all constraints at samples (%)")
    ax.set_xlabel(f"{_what_varies(next(iter(families.values())), plant)} (steps are not even)")
    legend_above(ax)
    caption = "Share of runs that keep all true constraints at samples, by margin."
    return [Picture(made, caption, "survival by margin and oracle")]


def by_family(results: list[CaseResult]) -> dict[str, list[CaseResult]]:
    """Cases that differ in the last of what varies alone, together."""
    families: dict[str, list[CaseResult]] = {}
    for result in results:
        families.setdefault(result.case.family, []).append(result)
    return families


def family_label(member: CaseResult) -> str:
    return member.case.family


def margins(members: list[CaseResult]) -> list[float]:
    """What varies from member to member: a number, or the one entry of a list that does."""
    values: list[Any] = [[0.0, *member.case.varied.values()][-1] for member in members]
    if not isinstance(values[0], list):
        return [float(value) for value in values]
    return [value[_varying(values)] for value in values]


def _what_varies(members: list[CaseResult], plant: Description) -> str:
    key, value = [("", 0.0), *members[0].case.varied.items()][-1]
    name = key.rpartition(".")[2]
    if not isinstance(value, list):
        return name
    at = _varying([member.case.varied[key] for member in members])
    return f"{name} of {plant.states[at]}" if len(value) == plant.d else f"{name}, entry {at}"


def _varying(values: list[list[float]]) -> int:
    return int(np.argmax(np.ptp(np.array(values, dtype=float), axis=0)))
