"""Regret by episode: what is left to learn when the plant starts again."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from run_log.reporting.plots import GREY
from tandem.experiments.reporting.style import Look, Picture, figure, legend_above, looks
from tandem.experiments.study.declaration import ORACLE
from tandem.experiments.study.results import CaseResult

LINEAR = 2.0
"""Percent. Up to here the axis is linear, beyond it logarithmic."""
TICKS = (-50, -20, -10, -5, -2, -1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Percent."""
LARGEST = 1000.0
"""Percent. What is above, or lost, is drawn there."""
COLUMNS = 3
"""Of panels, where there are several."""


def episodes(results: list[CaseResult]) -> list[Picture]:
    """J above that of the true h, one line for each oracle; one panel for each combination of what else varies."""
    panels: dict[str, list[CaseResult]] = {}
    for result in results:
        if result.oracle != "perfect":
            panels.setdefault(_panel(result), []).append(result)
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // max(1, columns))
    made, axes = figure(rows=rows, columns=columns, height=3.2 if len(panels) == 1 else 1.9)
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    for ax, (title, members) in zip(axes, panels.items(), strict=False):
        for result, look in zip(members, looks(members), strict=True):
            _line(ax, result, look)
        ax.axhline(0.0, color=GREY, linewidth=0.8, zorder=0)
        if len(panels) > 1:
            ax.set_title(title, fontsize=8, pad=3)
        ax.set_yscale("symlog", linthresh=LINEAR, linscale=0.8)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    lows, highs = zip(*(ax.get_ylim() for ax in axes[: len(panels)]), strict=True)
    low, high = max(min(lows), -50.0), min(max(highs), 1.15 * LARGEST)
    ticks = [tick for tick in TICKS if low <= tick <= high]
    for ax in axes[: len(panels)]:
        ax.set_ylim(low, high)
        ax.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        ax.minorticks_off()
    for ax in axes[::columns]:
        ax.set_ylabel("J above the true h's (%)")
    for ax in axes[-columns:]:
        ax.set_xlabel("episode")
    legend_above(axes[0], height=1.0 if len(panels) == 1 else 1.14, columns=2 if len(panels) == 1 else 3)
    caption = (
        "Regret by episode: J above that of the true h from the same start, in percent of it; the axis is linear up to "
        f"{LINEAR:g} % and logarithmic beyond. Line: median over the seeds; band: all of them."
    )
    return [Picture(made, caption, "regret by episode and oracle")]


def _panel(result: CaseResult) -> str:
    return ", ".join(words for key, words in result.case.words.items() if key != ORACLE)


def _line(ax: Axes, result: CaseResult, look: Look) -> None:
    """regret: (runs, episodes), percent."""
    regret = np.array(
        [[np.nan if r is None else 100 * r for r in row.regret_by_episode] for row in result.rows]
    )
    regret = np.minimum(regret, LARGEST)
    known = ~np.isnan(regret).all(axis=0)
    if not known.any():
        return
    number = 1 + np.flatnonzero(known)
    regret = regret[:, known]
    seeds = f" ({len(regret)} seeds)" if len(regret) > 1 else ""
    label = result.case.words.get(ORACLE, result.label) + seeds
    ax.plot(number, np.nanmedian(regret, axis=0), **look, linewidth=1.5, markersize=4.5, label=label)
    low, high = np.nanmin(regret, axis=0), np.nanmax(regret, axis=0)
    ax.fill_between(number, low, high, color=look["color"], alpha=0.18, linewidth=0)
