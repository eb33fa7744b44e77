"""How pictures look: told apart by line, marker and lightness as well as by colour (Okabe and Ito's)."""

from __future__ import annotations

import base64
import io
from typing import Any, NamedTuple

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from run_log.reporting.plots import BLACK, BLUE, GREEN, GREY, VERMILION
from tandem.experiments.study.results import CaseResult

WIDTH = 5.4
"""Inches: narrow, so that letters can still be read on a phone."""
FONT: Any = {"font.size": 9, "axes.titlesize": 9.5, "svg.hashsalt": "tandem", "svg.fonttype": "path"}


class Look(NamedTuple):
    colour: str
    line: tuple[int, tuple[float, ...]] | str
    marker: str


LOOKS = {
    "linear": Look(GREY, (0, (5, 1.5)), "s"),
    "l2nw": Look(VERMILION, (0, (5, 1.5, 1, 1.5)), "^"),
    "dnn": Look(BLUE, "-", "o"),
    "perfect": Look(BLACK, (0, (1, 1.2)), "D"),
}
MORE = (
    Look("#E69F00", (0, (3, 1, 1, 1, 1, 1)), "v"),
    Look(GREEN, (0, (8, 2)), "P"),
    Look("#CC79A7", (0, (2, 2)), "X"),
    Look("#56B4E9", "-", "*"),
)


def looks(results: list[CaseResult]) -> list[Look]:
    """One for each case: the first of an oracle has the oracle's own."""
    taken: set[str] = set()
    spare = iter(MORE * (1 + len(results) // len(MORE)))
    given = []
    for result in results:
        given.append(LOOKS[result.oracle] if result.oracle not in taken else next(spare))
        taken.add(result.oracle)
    return given


class Picture(NamedTuple):
    """One figure of the report."""

    figure: Figure
    caption: str
    alt: str


def figure(
    rows: int = 1, columns: int = 1, height: float = 2.7, share: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of `rows` by `columns` axes, each `height` inches high; the axes row by row."""
    with rc_context(FONT):
        made = Figure(figsize=(WIDTH, 0.5 + height * rows), layout="constrained")
        axes = made.subplots(rows, columns, squeeze=False, sharex=share, sharey=share and columns > 1)
    for ax in axes.ravel():
        ax.grid(True, color="#DDDDDD", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    return made, list(axes.ravel())


def legend_above(ax: Axes, columns: int = 2) -> None:
    """Above the axes, so that it hides nothing."""
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1.0),
        ncols=columns,
        frameon=False,
        fontsize=8.5,
        borderaxespad=0.2,
    )


def data_uri(made: Figure) -> str:
    """The figure as SVG inside a link that needs no network. The same figure gives the same text."""
    buffer = io.BytesIO()
    with rc_context(FONT):
        made.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
