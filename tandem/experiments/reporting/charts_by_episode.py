"""Charts of the regret by episode, which show the learning that remains after restarts of the plant."""

from __future__ import annotations

import numpy as np

from tandem.experiments.reporting.charts import Chart, Level, Line, Picture
from tandem.experiments.reporting.style import Look, looks
from tandem.experiments.study.declaration import ORACLE
from tandem.experiments.study.results import CaseResult

LINEAR = 2.0
"""Percent. The axis is linear up to here and logarithmic beyond."""
TICKS = (-50, -20, -10, -5, -2, -1, 0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
"""Percent."""
LARGEST = 1000.0
"""Percent. A larger regret is drawn here."""


def episodes(results: list[CaseResult]) -> list[Picture]:
    """Return the charts of J relative to the true h: a line per oracle, a chart per combination of the other values."""
    panels: dict[str, list[CaseResult]] = {}
    for result in results:
        if result.oracle != "perfect":
            panels.setdefault(_panel(result), []).append(result)
    what = "episode" if results[0].case.set_points is None else "cycle"
    charts = [_chart(title, members, what) for title, members in panels.items()]
    charts = [chart for chart in charts if chart.lines]
    every = [value for chart in charts for line in chart.lines for value in (line.y, line.low, line.high)]
    known = np.concatenate([value for value in every if value is not None] or [np.empty(0)])
    if not known.size:
        return []
    low, high = min(1.2 * known.min(), -0.5), max(1.3 * known.max(), 0.5)
    ticks = [float(tick) for tick in TICKS if low <= tick <= high]
    caption = (
        f"Regret by {what}: J above that of the true h from the same start. The axis is linear up to {LINEAR:g} % and "
        "logarithmic beyond. Line: the run, or the median over the seeds. Band: all seeds."
    )
    if known.max() >= LARGEST:
        caption += f" A regret above {LARGEST:g} % is drawn at {LARGEST:g} %."
    if any(row.lost is not None for result in results for row in result.rows):
        caption += " Lost runs are not drawn."
    return [
        Picture(
            chart._replace(ticks=ticks),
            caption if i == 0 else "",
            f"{chart.title}: regret by {what} and oracle",
        )
        for i, chart in enumerate(charts)
    ]


def _panel(result: CaseResult) -> str:
    return ", ".join(words for key, words in result.case.words.items() if key != ORACLE)


def _chart(title: str, members: list[CaseResult], what: str) -> Chart:
    lines = [_line(result, look) for result, look in zip(members, looks(members), strict=True)]
    return Chart(
        title=title or f"Regret by {what}",
        x_label=what,
        y_label="J above the true h's (%)",
        lines=[line for line in lines if len(line.x)],
        scale="asinh",
        linear_up_to=LINEAR,
        levels=(Level(0.0, "true h"),),
        whole=True,
    )


def _regret(result: CaseResult) -> np.ndarray:
    """Return the regret in percent, (runs, episodes); NaN if the plant was lost."""
    regret = [[np.nan if one is None else 100 * one for one in row.regret_by_episode] for row in result.rows]
    return np.minimum(np.array(regret), LARGEST)


def _line(result: CaseResult, look: Look) -> Line:
    regret = _regret(result)
    known = ~np.isnan(regret).all(axis=0)
    number, regret = 1.0 + np.flatnonzero(known), regret[:, known]
    label = result.case.words.get(ORACLE, result.label)
    if len(regret) < 2:
        return Line(label, look, number, regret[0] if len(regret) else number)
    low, high = np.nanmin(regret, axis=0), np.nanmax(regret, axis=0)
    return Line(label, look, number, np.nanmedian(regret, axis=0), low, high, len(regret))
