"""Pictures of many runs: regret of each case, initial states, survival. And which picture a group has."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import NullLocator

from lbmpc.plants import Plant
from run_log.reporting.plots import BLUE, GREY, VERMILION
from tandem.experiments.reporting.pictures_over_time import lemma, recovery, trajectories
from tandem.experiments.reporting.style import Picture, figure, full_name, legend_above, looks
from tandem.experiments.study.declaration import Picture as Kind
from tandem.experiments.study.results import CaseResult


def draw(kind: Kind, results: list[CaseResult], plant: Plant, reference: str | None) -> list[Picture]:
    """The pictures of one group."""
    match kind:
        case "trajectories":
            return trajectories(results, plant)
        case "states":
            return states(results, plant)
        case "survival":
            return survival(results)
        case "recovery":
            return recovery(results, plant)
        case "lemma":
            return lemma(results, plant)
        case "rows":
            return rows(results, reference)


def rows(results: list[CaseResult], reference: str | None) -> list[Picture]:
    """Regret of each case: median, and from the best to the worst run. Cost where a case has no regret."""
    what = "regret" if any(row.regret is not None for result in results for row in result.rows) else "cost"
    made, (ax,) = figure(height=0.45 + 0.27 * len(results))
    everything = np.concatenate([result.values(what) for result in results])
    finite = everything[np.isfinite(everything)]
    if not finite.size:
        return []
    right = float(finite.max()) * 1.4
    for i, result in enumerate(results):
        values, own = result.values(what), result.case.name == reference
        shown = np.minimum(values, right)
        middle = min(result.median(what), right)
        colour = BLUE if own else "black"
        reach = [shown.min(), shown.max()]
        ax.plot(reach, [i, i], color=colour, linewidth=3.5, alpha=0.25, solid_capstyle="butt")
        ax.plot(shown, np.full(len(shown), i), "|", color=colour, markersize=6, alpha=0.7)
        ax.plot(middle, i, "D" if own else "o", color=colour, markersize=5)
        lost = int((~np.isfinite(values)).sum())
        broken = sum(not record.kept for record in result.records)
        if lost or broken:
            said, beside = f"{broken} of {len(values)} leave the bounds", (shown.max(), i)
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
    ax.set_yticks(range(len(results)), [_wrapped(result.label) for result in results])
    ax.set_ylim(len(results) - 0.5, -0.5)
    ax.set_xlabel(f"{what}: sum of Δz² + Δy²{', above the true h' if what == 'regret' else ''}")
    marked = "; diamond and dashed line: what the others are compared with" if reference else ""
    caption = f"{what.capitalize()} of every run (strokes) and its median (dot){marked}."
    return [Picture(made, caption, f"{what} by case")]


def _wrapped(label: str) -> str:
    if len(label) <= 26:
        return label
    cut = label.rfind(" ", 0, 27)
    return label if cut < 0 else label[:cut] + "\n" + label[cut + 1 :]


def states(results: list[CaseResult], plant: Plant) -> list[Picture]:
    """Each initial state where it lies: kept, kept for some seeds, or not."""
    first, second = plant.performance[:2]
    columns = 2
    made, axes = figure(rows=-(-len(results) // columns), columns=columns, height=2.3)
    for ax in axes[len(results) :]:
        ax.set_visible(False)
    for ax, result in zip(axes, results, strict=False):
        kept_from: dict[tuple[float, float], list[bool]] = {}
        for row, record in zip(result.rows, result.records, strict=True):
            kept_from.setdefault((row.x0[first], row.x0[second]), []).append(record.kept)
        for (z, y), kept in kept_from.items():
            if all(kept):
                ax.plot(z, y, "o", color=BLUE, markersize=8)
            elif not any(kept):
                ax.plot(z, y, "x", color=VERMILION, markersize=8, markeredgewidth=2)
            else:
                ax.plot(z, y, "o", markerfacecolor="white", markeredgecolor=VERMILION, markersize=11)
                ax.text(z, y, f"{sum(kept)}", ha="center", va="center", fontsize=7.5)
        ax.plot(plant.x_e[first], plant.x_e[second], "+", color=GREY, markersize=14, zorder=0)
        ax.set_xlim(*_frame(plant, first))
        ax.set_ylim(*_frame(plant, second))
        ax.set_title(f"{result.label}: {result.kept:.0%} keep all", fontsize=9)
    for ax in axes[-columns:]:
        ax.set_xlabel(full_name(plant, first))
    for ax in axes[::columns]:
        ax.set_ylabel(full_name(plant, second))
    caption = (
        "Dot: every run from there keeps all true constraints; cross: none does; number: so many seeds do. "
        "The frame is the bounds, the plus in the middle the equilibrium."
    )
    return [Picture(made, caption, "initial states that are kept, by controller")]


def _frame(plant: Plant, i: int) -> tuple[float | None, float | None]:
    """A state's bounds; None where the axis is free, because there is none."""
    low, high = (float(bound[i]) if np.isfinite(bound[i]) else None for bound in (plant.x_min, plant.x_max))
    return low, high


def survival(results: list[CaseResult]) -> list[Picture]:
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
    ax.set_ylabel("runs that keep all constraints (%)")
    ax.set_xlabel("margin for w_y per second (half-width of W; steps are not even)")
    legend_above(ax)
    caption = "Share of runs that keep all true constraints, by margin."
    return [Picture(made, caption, "survival by margin and oracle")]


def by_family(results: list[CaseResult]) -> dict[str, list[CaseResult]]:
    """Cases that one declaration's `vary` made, together."""
    families: dict[str, list[CaseResult]] = {}
    for result in results:
        families.setdefault(result.case.name.partition(": ")[0], []).append(result)
    return families


def family_label(member: CaseResult) -> str:
    return member.label.partition(": ")[0]


def margins(members: list[CaseResult]) -> list[float]:
    """What varies from member to member: a number, or the one entry of a list that does."""
    values: list[Any] = [next(iter(member.case.varied.values()), 0.0) for member in members]
    if not isinstance(values[0], list):
        return [float(value) for value in values]
    table = np.array(values, dtype=float)
    column = int(np.argmax(np.ptp(table, axis=0)))
    return table[:, column].tolist()
