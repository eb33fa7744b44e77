"""Charts: lines over a common axis, described once and drawn as an interactive plot and as a PNG."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from tandem.experiments.reporting.style import Look, looks
from tandem.experiments.study.results import CaseResult

MOST = 1000
"""Points of a line on the page. A longer line is reduced to its envelope."""
DIGITS = 5
"""Significant digits of the values on the page."""


class Line(NamedTuple):
    """A line, with a band around it if it stands for several runs."""

    label: str
    look: Look
    x: np.ndarray
    """(n,)"""
    y: np.ndarray
    """(n,) the median over the runs; NaN is a gap."""
    low: np.ndarray | None = None
    high: np.ndarray | None = None
    """(n,) the smallest and the largest value of all runs."""
    runs: int = 1
    """Number of runs behind the line, if they differ."""

    @property
    def legend(self) -> str:
        return self.label if self.runs == 1 else f"{self.label} ({self.runs} runs)"


class Level(NamedTuple):
    """A horizontal line."""

    y: float
    label: str


class Chart(NamedTuple):
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    lines: list[Line]
    scale: str = "linear"
    """Scale of y: "linear", "log", or "asinh", which is linear near 0 and logarithmic beyond."""
    linear_up_to: float = 1.0
    """End of the linear range of "asinh"."""
    ticks: list[float] | None = None
    """Ticks of y; None: chosen by the plot."""
    levels: tuple[Level, ...] = ()
    bounds: tuple[float, float] | None = None
    """Bounds. The region outside is shaded if it is near the lines."""
    span: tuple[float, float] | None = None
    """Marked part of the x axis."""
    whole: bool = False
    """Whether x is a count, with whole numbers only."""


class Picture(NamedTuple):
    """One picture of the report: a chart, which is interactive on the page, or a static figure."""

    drawn: Chart | Figure
    caption: str
    alt: str


def of_runs(result: CaseResult, look: Look, values: list[np.ndarray]) -> Line | None:
    """Return the median of several runs over time, with the band of all of them; None if there is no run.

    values: one (n,) for each run, from the start.
    """
    if not values:
        return None
    # A timed run in which the plant was lost is shorter.
    shortest = min(map(len, values))
    runs = np.array([run[:shortest] for run in values], dtype=float)
    t = np.arange(runs.shape[1]) * result.case.config.period
    differ = len(runs) > 1 and bool((np.ptp(runs, axis=0) > 0).any())
    if not differ:
        return Line(result.label, look, t, runs[0])
    return Line(result.label, look, t, np.median(runs, axis=0), runs.min(axis=0), runs.max(axis=0), len(runs))


def lines_of(results: list[CaseResult], values: Callable[[CaseResult], list[np.ndarray]]) -> list[Line]:
    """Return one line for each case that has runs. values: gives the (n,) of each run of a case."""
    made = (
        of_runs(result, look, values(result)) for result, look in zip(results, looks(results), strict=True)
    )
    return [line for line in made if line is not None]


def reduced(line: Line, most: int = MOST) -> Line:
    """Return a line of at most about `most` points that has the same smallest and largest values.

    Each pair of points stands for one stretch of samples: the smallest and the largest of them, in the order in which
    they occur. A band keeps the smallest low and the largest high of each stretch.
    """
    if len(line.x) <= most:
        return line
    edges = np.linspace(0, len(line.x), most // 2 + 1).astype(int)
    x, y, low, high = [], [], [], []
    for first, last in pairwise(edges):
        part = line.y[first:last]
        x += [line.x[first], line.x[last - 1]]
        if np.isnan(part).all():
            y += [math.nan, math.nan]
        else:
            smallest, largest = int(np.nanargmin(part)), int(np.nanargmax(part))
            y += [part[min(smallest, largest)], part[max(smallest, largest)]]
        if line.low is not None and line.high is not None:
            low += 2 * [np.nanmin(line.low[first:last])]
            high += 2 * [np.nanmax(line.high[first:last])]
    band = (np.array(low), np.array(high)) if low else (None, None)
    return line._replace(x=np.array(x), y=np.array(y), low=band[0], high=band[1])


def to_page(chart: Chart) -> dict[str, Any]:
    """Return the chart as plain values for the page's script. Lines share one x; missing values are null."""
    lines = [reduced(line) for line in chart.lines]
    x = np.unique(np.concatenate([line.x for line in lines])) if lines else np.empty(0)

    def column(line: Line, values: np.ndarray | None) -> list[float | None] | None:
        if values is None:
            return None
        found = np.full(len(x), np.nan)
        # A logarithmic axis cannot show 0.
        found[np.searchsorted(x, line.x)] = (
            np.where(values > 0, values, np.nan) if chart.scale == "log" else values
        )
        return [_rounded(value) for value in found.tolist()]

    shown: list[float | None] = [_rounded(value) for value in x.tolist()]
    told: dict[str, Any] = {
        "title": chart.title,
        "xLabel": chart.x_label,
        "yLabel": chart.y_label,
        "scale": chart.scale,
        "linear": chart.linear_up_to,
        "ticks": chart.ticks,
        "levels": [{"y": level.y, "label": level.label} for level in chart.levels],
        "bounds": chart.bounds and [bound if math.isfinite(bound) else None for bound in chart.bounds],
        "span": chart.span,
        "whole": chart.whole,
        "x": shown,
        "lines": [
            {
                "name": line.label,
                "label": line.legend,
                "color": line.look["color"],
                "dash": _dash(line.look),
                "y": column(line, line.y),
                "low": column(line, line.low),
                "high": column(line, line.high),
            }
            for line in lines
        ],
        "reduced": max((len(line.x) for line in chart.lines), default=0) > MOST,
    }
    return {key: value for key, value in told.items() if value not in (None, [], False)}


def _rounded(value: float) -> float | None:
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None


def _dash(look: Look) -> list[float]:
    """Return the dashes in pixels, from Matplotlib's "-" or (offset, lengths)."""
    return [] if look["linestyle"] == "-" else [2.0 * length for length in look["linestyle"][1]]
