"""Regret by episode: what is left to learn when the plant starts again."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from run_log.reporting.plots import GREY
from tandem.experiments.reporting.style import Look, Picture, figure, looks
from tandem.experiments.study.declaration import ORACLE
from tandem.experiments.study.results import CaseResult

LINEAR = 2.0
"""Percent. Up to here the axis is linear, beyond it logarithmic."""
TICKS = (-50, -20, -10, -5, -2, -1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Percent."""
LARGEST = 1000.0
"""Percent. What is above is drawn there."""
COLUMNS = 3
"""Of panels, where there are several."""


def episodes(results: list[CaseResult]) -> list[Picture]:
    """J above that of the true h, one line for each oracle; one panel for each combination of what else varies."""
    panels: dict[str, list[CaseResult]] = {}
    for result in results:
        if result.oracle != "perfect":
            panels.setdefault(_panel(result), []).append(result)
    shown = [_regret(result) for members in panels.values() for result in members]
    known = np.concatenate([regret[~np.isnan(regret)] for regret in shown] or [np.empty(0)])
    if not known.size:
        return []
    columns = min(COLUMNS, len(panels))
    made, axes = figure(
        rows=-(-len(panels) // columns), columns=columns, height=3.2 if len(panels) == 1 else 1.7
    )
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    low, high = min(1.2 * known.min(), -0.5), max(1.3 * known.max(), 0.5)
    ticks = [tick for tick in TICKS if low <= tick <= high]
    for ax, (title, members) in zip(axes, panels.items(), strict=False):
        for result, look in zip(members, looks(members), strict=True):
            _line(ax, result, look)
        ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
        ax.set_title(title, fontsize=8, pad=3)
        ax.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
        ax.set_ylim(low, high)
        ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for ax in axes[::columns]:
        ax.set_ylabel("J above the true h's (%)")
    for ax in axes[-columns:]:
        ax.set_xlabel(_what(results))
    # One for all panels, outside of them.
    lines, labels = axes[0].get_legend_handles_labels()
    made.legend(lines, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=8.5)
    caption = (
        f"Regret by {_what(results)}: J above that of the true h from the same start, in percent of it; the axis is "
        f"linear up to {LINEAR:g} % and logarithmic beyond. Line: median over the seeds; band: all of them. "
        f"What is above {LARGEST:g} % is drawn there, and what was lost is not drawn."
    )
    return [Picture(made, caption, f"regret by {_what(results)} and oracle")]


def _what(results: list[CaseResult]) -> str:
    return "episode" if results[0].case.set_points is None else "cycle"


def _panel(result: CaseResult) -> str:
    return "\n".join(words for key, words in result.case.words.items() if key != ORACLE)


def _regret(result: CaseResult) -> np.ndarray:
    """(runs, episodes) percent; NaN where the plant was lost."""
    regret = [[np.nan if one is None else 100 * one for one in row.regret_by_episode] for row in result.rows]
    return np.minimum(np.array(regret), LARGEST)


def _line(ax: Axes, result: CaseResult, look: Look) -> None:
    regret = _regret(result)
    known = ~np.isnan(regret).all(axis=0)
    number, regret = 1 + np.flatnonzero(known), regret[:, known]
    seeds = f" ({len(regret)} seeds)" if len(regret) > 1 else ""
    label = result.case.words.get(ORACLE, result.label) + seeds
    ax.plot(number, np.nanmedian(regret, axis=0), **look, linewidth=1.5, markersize=4.5, label=label)
    low, high = np.nanmin(regret, axis=0), np.nanmax(regret, axis=0)
    ax.fill_between(number, low, high, color=look["color"], alpha=0.18, linewidth=0)
