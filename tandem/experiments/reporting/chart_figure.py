"""A chart as a Matplotlib figure, for `pictures/` beside the report."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from run_log.reporting.canvas import words
from run_log.reporting.plots import GREY, VERMILION
from tandem.experiments.reporting.charts import Chart, Line
from tandem.experiments.reporting.style import figure, legend_above

NEAR = 0.6
"""Largest distance of a drawn bound from the lines, as a share of their range."""

LONG = 26
"""Length of a label from which the legend has one column."""


def chart_figure(chart: Chart) -> Figure:
    """Draw a chart."""
    columns = 2 if max((len(line.legend) for line in chart.lines), default=0) <= LONG else 1
    made, (ax,) = figure(height=2.8 + 0.17 * -(-len(chart.lines) // columns))
    # The scale comes first: what is drawn sets the limits, with margins in the units of the scale.
    if chart.scale == "log":
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
    elif chart.scale == "asinh":
        ax.set_yscale("symlog", linthresh=chart.linear_up_to, linscale=0.8)
        ax.minorticks_off()
    for line in chart.lines:
        _line(ax, line)
    for level in chart.levels:
        ax.axhline(level.y, color=GREY, linewidth=0.8, linestyle=(0, (6, 2)), zorder=0)
    if chart.span is not None:
        ax.axvspan(*chart.span, color=GREY, alpha=0.3, linewidth=0)
    if chart.ticks is not None:
        ax.set_yticks(chart.ticks, [f"{tick:g}" for tick in chart.ticks])
    if chart.bounds is not None:
        _bounds(ax, *chart.bounds)
    if chart.whole:
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel(words(chart.x_label))
    ax.set_ylabel(words(chart.y_label))
    legend_above(ax, columns=columns)
    if chart.title:
        made.suptitle(words(chart.title), fontsize=9, x=0.02, ha="left")
    return made


def _line(ax: Axes, line: Line) -> None:
    look = {"marker": "", **line.look}
    every = len(line.x) // 20, max(1, len(line.x) // 8)
    label = words(line.legend)
    ax.plot(line.x, line.y, **look, linewidth=1.5, markevery=every, markersize=4, label=label)
    if line.low is not None and line.high is not None:
        ax.fill_between(line.x, line.low, line.high, color=look["color"], alpha=0.18, linewidth=0)


def _bounds(ax: Axes, lowest: float, highest: float) -> None:
    low, high = ax.get_ylim()
    reach = NEAR * (high - low)
    shown = [b for b in (lowest, highest) if np.isfinite(b) and low - reach < b < high + reach]
    low, high = min([low, *shown]), max([high, *shown])
    margin = 0.05 * (high - low)
    ax.set_ylim(low - margin, high + margin)
    for bound in shown:
        ax.axhline(bound, color=VERMILION, linewidth=1.0, linestyle=(0, (6, 2)))
        beyond = low - margin if bound == lowest else high + margin
        ax.axhspan(bound, beyond, color=VERMILION, alpha=0.10, linewidth=0, hatch="///")
